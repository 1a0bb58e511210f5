"""How sharply the matched points hold a pose."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg._core.typing import Motion
from jaxreg.linear.small import solve_semidefinite
from jaxreg.local.covariance import pose_covariance
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps import condition, gyration_radius
from jaxreg.matching.problem import Match, Problem
from jaxreg.matching.residuals import AbstractResidual, PointToPlane, PointToPoint


# Least over largest curvature of the energy below which a direction of the motion is
# taken as free; rounding in float32 leaves about 1e-6.
_DEGENERATE = 1e-5


class Curvature(eqx.Module):
    """The quadratic model of the energy at a pose, in the tangent (v, w).

    The pose moves by R -> exp(w) R, c -> c + v, with c the image of the source's
    centroid.

    Attributes:
        H: `(k, k)` Gauss-Newton matrix of the weighted energy.
        b: `(k,)` its descent direction, zero at a minimum.
        error: the energy, sum of w r^2 / 2.
        covariance: `(k, k)` of the pose, see `pose_covariance`.
    """

    H: Float[Array, "k k"]
    b: Float[Array, " k"]
    error: Float[Array, ""]
    covariance: Float[Array, "k k"]

    @classmethod
    def of(
        cls,
        optimiser: LocalOptimiser,
        problem: Problem,
        T_target_source: Motion,
        found: Match,
        width: Float[Array, ""],
    ) -> "Curvature":
        """At a pose, given its match and the kernel width there."""
        weight = optimiser.weights(found, width)
        residual = optimiser.residual
        H, b = residual.normal_equations(found, weight)
        frozen = optimiser, problem, T_target_source, found, width, weight, H
        covariance = pose_covariance(*lax.stop_gradient(frozen))
        return cls(H, b, residual.energy(found, weight), covariance)

    def scaled(self, length: Float[Array, ""]) -> "Curvature":
        """In a unit of length that is 1 / `length` times the present one."""
        unit = tangent_unit(length, self.b.shape[0])
        sq = length * length
        return Curvature(
            H=self.H * sq / jnp.outer(unit, unit),
            b=self.b * sq / unit,
            error=self.error * sq,
            covariance=self.covariance * jnp.outer(unit, unit),
        )


def tangent_unit(length: Float[Array, ""], k: int) -> Float[Array, " k"]:
    """`length` for the translation, one for the rotation, of k numbers."""
    return jnp.where(jnp.arange(k) < (2 if k == 3 else 3), length, 1)


def sandwich(H: Float[Array, "k k"], meat: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """H^-1 meat H^-1, without the directions that H leaves free (Huber 1967)."""
    eye = jnp.eye(H.shape[0], dtype=H.dtype)
    bread = jax.vmap(solve_semidefinite, (None, 1), 1)(H, eye)
    return full_matmul(bread, full_matmul(meat, bread.T))


def is_degenerate(
    residual: AbstractResidual, found: Match, weight: Float[Array, " n"]
) -> Array:
    """Whether the matched surfaces leave some direction of the motion free."""
    sharp = residual if isinstance(residual, PointToPoint) else PointToPlane(0.0)
    H = sharp.normal_equations(found, weight)[0]
    return condition(H, gyration_radius(found, weight)) < _DEGENERATE
