"""How a pose follows from a match: the step of a local optimiser."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Motion
from jaxreg.geometry import lie
from jaxreg.geometry.kabsch import nearest_rotation
from jaxreg.local.problem import Match
from jaxreg.local.residuals import AbstractResidual, Moments, PointToPoint


class AbstractStep(eqx.Module):
    """One update of the pose with correspondences and weights held."""

    @abc.abstractmethod
    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """The updated pose; the pose itself where the weights are all zero."""


class ClosedForm(AbstractStep):
    """The exact minimiser of the weighted point-to-point error (Kabsch)."""

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
        T = lie.compose(turn @ R, x + t + r - turn @ x)
        return jnp.where(moments.total > 0, T, T_target_source)


class GaussNewton(AbstractStep):
    """Solves the damped normal equations of the residual.

    Attributes:
        damping: added to the diagonal of H, relative to its mean; keeps the step
            finite where the data leave a direction free.
    """

    damping: Array | float = traced(1e-5)

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """R p + t -> exp(w) R p + t + v."""
        H, b = residual.normal_equations(match, weight)
        k = b.shape[0]
        # The floor keeps H positive definite where nothing matches.
        level = jnp.asarray(self.damping, b.dtype) * jnp.trace(H) / k
        level = level + jnp.finfo(b.dtype).tiny ** 0.5
        factor = cho_factor(H + level * jnp.eye(k, dtype=b.dtype))
        return turn_and_shift(T_target_source, cho_solve(factor, b))


def turn_and_shift(T_target_source: Motion, tangent: Float[Array, " k"]) -> Motion:
    """Applies (v, w) about the origin of the source: R -> exp(w) R, t -> t + v."""
    d = T_target_source.shape[-1] - 1
    return lie.compose(
        lie.rotation_exp(tangent[d:]) @ lie.rotation(T_target_source),
        lie.translation(T_target_source) + tangent[:d],
    )


def decoupled_error(
    T_after: Float[Array, "D D"], T_before: Float[Array, "D D"]
) -> Float[Array, " k"]:
    """(v, w) with `turn_and_shift(T_before, (v, w)) = T_after` (PF paper, Eq. 6)."""
    w = lie.rotation_log(lie.rotation(T_after) @ lie.rotation(T_before).T)
    v = lie.translation(T_after) - lie.translation(T_before)
    return jnp.concatenate([v, w])
