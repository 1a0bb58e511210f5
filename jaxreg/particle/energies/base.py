"""The contract of energies."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Scalar
from jaxreg.matching import Match


class AbstractEnergy(BriefModule):
    """E of p(z_t | x_t) = exp(-E / temperature) (PF paper, section 3.3, step 2).

    The paper prints the exponent without its minus. Energies are means over the valid
    source points, so that their number does not matter; the temperature is learned.

    Attributes:
        resolution: n independent points do not tell energies apart that differ by less
            than this over n, so the temperature does not fall below that; zero where
            the energy has no scale of its own.
    """

    described: ClassVar[str] = "an energy such as BoundedEnergy()"

    resolution: ClassVar[float]

    @abc.abstractmethod
    def __call__(self, found: Match, width: Scalar) -> Scalar:
        """Of the correspondences at a pose.

        Args:
            found: the match at the pose.
            width: kernel width of the present time, in the unit of the match.
        """


def mean_over_source(value: Float[Array, " n"], found: Match) -> Float[Array, ""]:
    """The mean over the valid source points; zero where there are none."""
    total = jnp.maximum(jnp.sum(found.mask), 1).astype(value.dtype)
    return jnp.sum(jnp.where(found.mask, value, 0)) / total
