"""Point to point."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals.base import AbstractResidual
from jaxreg.matching.residuals.gram import Moments, half_sum, wrench


class PointToPoint(AbstractResidual):
    """q - (R p + t) (PF paper, Eq. 3; Besl and McKay 1992).

    Needs no normals; any step. It slides slowly along surfaces, so it takes several
    times the iterations of the residuals that use normals.
    """

    uses_normals: ClassVar[bool] = False

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """From the weighted second moments of lever arms and residuals."""
        moments = Moments.of(match, weight)
        x, xx, xr = moments.x, moments.xx, moments.xr
        d = x.shape[0]
        eye = jnp.eye(d, dtype=x.dtype)
        # The Jacobian of a point is [I, G(x)] with G(x) w = w cross x.
        if d == 2:
            G = jnp.stack([-x[1], x[0]])[:, None]
            GG = jnp.trace(xx)[None, None]
            Gr = (xr[0, 1] - xr[1, 0])[None]
        else:
            G = -lie.hat(x)
            GG = jnp.trace(xx) * eye - xx
            Gr = jnp.stack(
                [xr[1, 2] - xr[2, 1], xr[2, 0] - xr[0, 2], xr[0, 1] - xr[1, 0]]
            )
        H = jnp.block([[moments.total * eye, G], [G.T, GG]])
        return H, jnp.concatenate([moments.r, Gr])

    def descents(self, match: Match) -> Float[Array, "k n"]:
        """The wrench of r."""
        return wrench(match.residual, match.rotated)

    def energy(self, match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
        """Sum of w |r|^2 / 2."""
        return half_sum(match.sq_residual, weight)
