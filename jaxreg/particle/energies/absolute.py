"""Absolute energy."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_positive
from jaxreg._core.typing import Scalar
from jaxreg.matching import Match
from jaxreg.particle.energies.base import AbstractEnergy, mean_over_source


class AbsoluteEnergy(AbstractEnergy):
    """Mean of sqrt(|r|^2 + epsilon^2): what the PF paper proposes in section 6.

    Less of noise and outliers than `SquaredEnergy`. Ignores the width.

    Attributes:
        epsilon: smooths the corner at zero, in root mean square radii of the target.
    """

    resolution: ClassVar[float] = 0.0
    epsilon: Array | float = traced(0.01)

    def __check_init__(self) -> None:
        """Refuses what would leave the corner."""
        check_positive(self, "epsilon")

    def __call__(self, found: Match, width: Scalar) -> Scalar:
        """The smoothed L1 energy."""
        sq = found.sq_residual + jnp.asarray(self.epsilon, width.dtype) ** 2
        return mean_over_source(jnp.sqrt(sq), found)
