"""How sharply the matched points hold a pose."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.local.problem import Match
from jaxreg.local.residuals import AbstractResidual, PointToPlane, PointToPoint
from jaxreg.local.residuals.gram import weighted_gram
from jaxreg.local.steps import condition, gyration_radius
from jaxreg.local.steps.base import full_matmul
from jaxreg.local.steps.tiny_solve import solve_semidefinite


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
        covariance: `(k, k)` of the pose: H^-1 (sum of w^2 g g') H^-1 with g the
            gradients of the points (Huber's sandwich), right for independent errors
            of any size, too small where neighbouring points err together.
    """

    H: Float[Array, "k k"]
    b: Float[Array, " k"]
    error: Float[Array, ""]
    covariance: Float[Array, "k k"]

    @classmethod
    def of(
        cls, residual: AbstractResidual, found: Match, weight: Float[Array, " n"]
    ) -> "Curvature":
        """At the pose of a match."""
        H, b = residual.normal_equations(found, weight)
        meat = weighted_gram(residual.descents(found), weight * weight)
        return cls(H, b, residual.energy(found, weight), sandwich(H, meat))

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
