"""Bounded energy."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative, check_positive
from jaxreg._core.typing import Scalar
from jaxreg.matching import Match, known
from jaxreg.particle.energies.base import AbstractEnergy


# Heights over the surface, in widths, that contradict it most.
_OVER = 1.5


class BoundedEnergy(AbstractEnergy):
    """1 - mean of agreement (support - conflict), bounded by 0 and 2.

    support = 1 / (1 + (h^2 + (slide a)^2) / (narrow width)^2)
    conflict = 4 x / (1 + x)^2 / (1 + (a / width)^4), x = (h / (1.5 width))^2

    h is the height over the target's tangent plane (line in 2D), a the distance along
    it. Between samples of the same surface a is as large as their spacing, which says
    nothing of the pose; so it counts little. Bounded, as partial overlap needs it:
    points of the source without a counterpart cost one, however far away they are.
    But points that are over or under the surface, by about 1.5 widths, and not beyond
    its border, contradict the pose: where two scans show the same place they show it
    at the same height.
    Agreement is the squared cosine between the normals, one where there are none; then
    h is the whole distance.

    Attributes:
        slide: how much a distance along the surface counts.
        narrow: width of the energy in that of the optimiser, which has to reach
            farther than what is to be told apart.
    """

    resolution: ClassVar[float] = 4.0
    slide: Array | float = traced(0.3)
    narrow: Array | float = traced(0.5)

    def __check_init__(self) -> None:
        """Refuses factors that say nothing."""
        check_not_negative(self, "slide")
        check_positive(self, "narrow")

    def __call__(self, found: Match, width: Scalar) -> Scalar:
        """The share of the source that has no counterpart or a wrong one, softly."""
        sq = found.sq_residual
        flat = known(found.normal)
        height_sq = jnp.where(flat, found.plane_residual**2, sq)
        slide, narrow = (jnp.asarray(x, sq.dtype) for x in (self.slide, self.narrow))
        along_sq = jnp.maximum(sq - height_sq, 0)
        sq = height_sq + slide**2 * along_sq
        over = height_sq / (_OVER * width) ** 2
        conflict = 4 * over / ((1 + over) ** 2 * (1 + (along_sq / width**2) ** 2))
        support = 1 / (1 + sq / (narrow * width) ** 2) - conflict
        support = found.agreement * support
        total = jnp.maximum(jnp.sum(found.mask), 1).astype(support.dtype)
        return 1 - jnp.sum(support) / total
