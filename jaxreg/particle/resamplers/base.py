"""The contracts of resamplers, and the rule of when to resample."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import place_among
from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import check_not_negative
from jaxreg._core.typing import Key
from jaxreg.particle.state import Particles
from jaxreg.particle.weights import effective_sample_size


class AbstractResampler(BriefModule):
    """Replaces weighted particles by others that weigh about the same.

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
    def replace(
        self, key: Key, particles: Particles, num: int
    ) -> tuple[Particles, Int[Array, " p"]]:
        """`num` particles in the first rows, and the row that each is most of.

        Weighted means stay as they are in expectation, or nearly. Energies of the
        result mean nothing, nor do rows beyond `num`, which have no weight.

        Args:
            key: randomness.
            particles: with normalised weights, -inf for rows that are not in use.
            num: how many there shall be, at most p.
        """

    def __call__(
        self,
        key: Key,
        particles: Particles,
        num: int,
        may_keep: Bool[Array, ""] | bool,
    ) -> tuple[Particles, Int[Array, " p"]]:
        """`replace`, where the threshold asks for it; else the particles and rows.

        Args:
            key: randomness.
            particles: with normalised weights, -inf for rows that are not in use.
            num: how many there shall be, in the first rows.
            may_keep: False where resampling must take place, as their number changes.
        """
        others, rows = self.replace(key, particles, num)
        size = effective_sample_size(particles.log_weight)
        keep = may_keep & (self.threshold < 1) & (size >= self.threshold * num)
        out = jax.tree.map(lambda a, b: jnp.where(keep, a, b), particles, others)
        return out, jnp.where(keep, jnp.arange(len(rows)), rows).astype(jnp.int32)


class AbstractHardResampler(AbstractResampler):
    """Copies particles, which weigh the same after (PF paper, section 3.4).

    Gradients: poses have those of the rows that they are copies of. How often a
    particle is copied jumps with its weight, which nothing can follow: what depends on
    the weights before is left out, so that gradients through several times are biased.
    `Soft` and `Transport` are there for these.

    Attributes:
        threshold: see `AbstractResampler`.
    """

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

    def ancestors(
        self, key: Key, weight: Float[Array, " p"], num: int
    ) -> Int[Array, " p"]:
        """`draw`, of rows that have a weight."""
        rows = self.draw(key, weight, num)
        # Rounding may lead past the last particle that has a weight.
        return jnp.where(weight[rows] > 0, rows, jnp.argmax(weight)).astype(jnp.int32)

    def replace(
        self, key: Key, particles: Particles, num: int
    ) -> tuple[Particles, Int[Array, " p"]]:
        """Copies of equal weight."""
        rows = self.ancestors(key, jnp.exp(particles.log_weight), num)
        return particles.rows(rows).weighted(equal(particles.log_weight, num)), rows


def equal(like: Float[Array, " p"], num: int) -> Float[Array, " p"]:
    """Logarithms of equal weights of the first `num` rows."""
    level = -jnp.log(jnp.asarray(num, like.dtype))
    return jnp.where(jnp.arange(like.size) < num, level, -jnp.inf)


def rows_at(weight: Float[Array, " p"], share: Float[Array, " q"]) -> Int[Array, " q"]:
    """The rows in which the cumulated share of the weight exceeds `share` in [0, 1)."""
    cumulative = jnp.cumsum(weight)
    rows = place_among(cumulative, share * cumulative[-1], "right")
    return jnp.minimum(rows, weight.shape[0] - 1).astype(jnp.int32)
