"""The closed-form step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg._core.typing import Motion
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.local.steps.base import AbstractStep
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals import AbstractResidual, Moments, PointToPoint


class ClosedForm(AbstractStep):
    """The exact minimiser of the weighted point-to-point error (Kabsch 1976).

    Raises TypeError while tracing for any other residual.
    """

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """Fits the moved source to its closest points from their moments."""
        if not isinstance(residual, PointToPoint):
            raise TypeError(
                "ClosedForm solves PointToPoint only; use GaussNewton for "
                f"{type(residual).__name__}."
            )
        moments = Moments.of(match, weight)
        total = jnp.where(moments.total > 0, moments.total, 1)
        x, r = moments.x / total, moments.r / total
        # Covariance of q = x + t + r with x, the lever arms.
        xx = moments.xx / total - jnp.outer(x, x)
        rx = moments.xr.T / total - jnp.outer(r, x)
        turn = nearest_rotation(xx + rx)
        R, t = lie.rotation(T_target_source), lie.translation(T_target_source)
        T = lie.compose(
            full_matmul(turn, R), x + t + r - jnp.sum(turn * x[None], axis=1)
        )
        return jnp.where(moments.total > 0, T, T_target_source)
