"""The contract of residuals.

The pose is updated on the left about the origin of the lever arms,
R p + t -> exp(w) R p + t + v, with the tangent (v, w), so a point moves by
v + w x (R p). A residual r = q - (R p + t) (or a projection of it) contributes
H = sum_i w_i J_i^T J_i and b = sum_i w_i J_i^T r_i with J the derivative of the moved
point, so b is minus the gradient of the energy and the Gauss-Newton step solves
H (v, w) = b.
"""

import abc
from typing import ClassVar

from jaxtyping import Array, Float

from jaxreg._core.brief import BriefModule
from jaxreg.matching.problem import Match


class AbstractResidual(BriefModule):
    """What is made small.

    Attributes:
        uses_normals: whether matches also count by the agreement of their normals.
    """

    described: ClassVar[str] = "a residual such as PointToPlane()"

    uses_normals: ClassVar[bool]

    @abc.abstractmethod
    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """H and b for the tangent (v, w), translation first."""

    @abc.abstractmethod
    def descents(self, match: Match) -> Float[Array, "k n"]:
        """What each point adds to b at weight one: J^T r."""

    @abc.abstractmethod
    def energy(self, match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
        """The weighted sum of half squared residuals, of which b is the descent.

        Evaluated at a `moved` match it is the energy with correspondences held.
        """
