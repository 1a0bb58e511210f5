"""Point to plane; point to line in 2D."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative
from jaxreg.matching.problem import Match, rotate
from jaxreg.matching.residuals.base import AbstractResidual
from jaxreg.matching.residuals.gram import half_sum, wrench
from jaxreg.matching.residuals.metric import identity, metric_equations, outer


class PointToPlane(AbstractResidual):
    """n . (q - (R p + t)) with the target's normal (Chen and Medioni 1992).

    In 2D, point-to-line. A small share of the point-to-point residual holds the
    directions in which a flat surface slides; with a share of zero they are free.

    Attributes:
        point_share: weight of the point-to-point residual beside it.
    """

    uses_normals: ClassVar[bool] = True
    point_share: Array | float = traced(0.05)

    def __check_init__(self) -> None:
        """Refuses a negative share."""
        check_not_negative(self, "point_share")

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """Of the metric n n^T + point_share I."""
        share = jnp.asarray(self.point_share, weight.dtype)
        normal = rotate(match.R.T, match.normal)
        metric = outer(normal) + share * identity(len(normal), normal.dtype)
        return metric_equations(match, weight, metric, self._force(match))

    def descents(self, match: Match) -> Float[Array, "k n"]:
        """The wrench of (n . r) n plus the share of r."""
        return wrench(self._force(match), match.rotated)

    def energy(self, match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
        """Sum of w ((n . r)^2 + point_share |r|^2) / 2."""
        share = jnp.asarray(self.point_share, weight.dtype)
        plane = match.plane_residual
        return half_sum(plane * plane + share * match.sq_residual, weight)

    def _force(self, match: Match) -> Float[Array, "d n"]:
        share = jnp.asarray(self.point_share, match.residual.dtype)
        return match.plane_residual[None] * match.normal + share * match.residual
