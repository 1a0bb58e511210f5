"""The contract of resamplers, and the rule of when to resample."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import check_not_negative
from jaxreg._core.typing import Key
from jaxreg.particle.weights import effective_sample_size


class AbstractResampler(BriefModule):
    """Replaces weighted particles by copies (PF paper, section 3.4).

    Attributes:
        threshold: particles are resampled only where their effective sample size,
            1 / sum w^2, is less than this share of their number; else the weights
            carry over to the next time (w_{t-1} of Eq. 9). One or more: always, as in
            the paper.

    Raises: ValueError for a negative threshold.
    """

    described: ClassVar[str] = "a resampler such as Systematic()"

    threshold: eqx.AbstractVar[Array | float]

    def __check_init__(self) -> None:
        """Refuses a negative threshold."""
        check_not_negative(self, "threshold")

    @abc.abstractmethod
    def draw(
        self, key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
    ) -> Int[Array, " p"]:
        """Ancestors, of which i has num * weight_i in expectation.

        Args:
            key: randomness.
            weight: `(p,)` normalised.
            num: how many to draw, at most p; rows of the result beyond it mean nothing.
        """

    def __call__(
        self,
        key: Key,
        log_weight: Float[Array, " p"],
        num: Int[Array, ""] | int,
        may_keep: Bool[Array, ""] | bool,
    ) -> tuple[Int[Array, " p"], Float[Array, " p"]]:
        """Ancestors of `num` particles and the logarithms of their weights.

        Args:
            key: randomness.
            log_weight: `(p,)` normalised, -inf for rows that are not in use.
            num: how many particles there shall be, in the first rows.
            may_keep: False where resampling must take place, as their number changes.
        """
        weight = jnp.exp(log_weight)
        rows = self.draw(key, weight, num)
        # Rounding may lead past the last particle that has a weight.
        rows = jnp.where(weight[rows] > 0, rows, jnp.argmax(weight))
        place = jnp.arange(weight.size)
        count = jnp.asarray(num, weight.dtype)
        equal = jnp.where(place < num, -jnp.log(count), -jnp.inf)
        size = effective_sample_size(log_weight)
        keep = may_keep & (self.threshold < 1) & (size >= self.threshold * count)
        rows = jnp.where(keep, place, rows).astype(jnp.int32)
        return rows, jnp.where(keep, log_weight, equal)


def rows_at(weight: Float[Array, " p"], share: Float[Array, " q"]) -> Int[Array, " q"]:
    """The rows in which the cumulated share of the weight exceeds `share` in [0, 1)."""
    cumulative = jnp.cumsum(weight)
    rows = jnp.searchsorted(cumulative, share * cumulative[-1], side="right")
    return jnp.minimum(rows, weight.shape[0] - 1).astype(jnp.int32)
