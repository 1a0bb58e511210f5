"""Squared energy."""

from typing import ClassVar

from jaxreg._core.typing import Scalar
from jaxreg.matching import Match
from jaxreg.particle.energies.base import AbstractEnergy, mean_over_source


class SquaredEnergy(AbstractEnergy):
    """Mean of |r|^2: the PF paper's own (Eq. 3; section 3.3, step 2). Ignores width.

    For clouds that overlap fully: a far part without counterpart decides everything.
    """

    resolution: ClassVar[float] = 0.0

    def __call__(self, found: Match, width: Scalar) -> Scalar:
        """The L2 energy of ICP."""
        return mean_over_source(found.sq_residual, found)
