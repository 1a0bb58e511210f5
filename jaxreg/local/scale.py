"""The scale of the source as one more unknown of a step (Umeyama 1991; Zha, Du 2010).

A residual contributes J^T r and J^T J with J the derivative of the moved point by the
tangent (v, w); for the logarithm of the scale that derivative is the lever arm x
itself. Every residual is quadratic in r, so replacing r by r - s x and differentiating
by s gives the missing row of its normal equations, whatever its metric.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, rms_radius
from jaxreg.geometry import lie
from jaxreg.linear.small import solve_semidefinite
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals import AbstractResidual


# A factor in one step at most; far from the solution matches shrink the source.
_MOST = 0.3


def fit_scale(
    residual: AbstractResidual, found: Match, weight: Float[Array, " n"]
) -> tuple[Float[Array, ""], Match]:
    """The factor that belongs to the joint step of scale and pose, and the match after.

    The pose is eliminated (Schur complement), so that a step of the pose on the match
    after completes the joint Gauss-Newton step.
    """

    def at(s: Array) -> tuple[Array, Array]:
        grown = eqx.tree_at(
            lambda m: m.residual, found, found.residual - s * found.rotated
        )
        b = residual.normal_equations(grown, weight)[1]
        return b, residual.energy(grown, weight)

    zero, one = jnp.zeros((), weight.dtype), jnp.ones((), weight.dtype)

    def slope(s: Array) -> tuple[Array, Array]:
        return jax.jvp(at, (s,), (one,))[1]

    (coupling, ascent), (_, stiffness) = jax.jvp(slope, (zero,), (one,))
    H, b = residual.normal_equations(found, weight)
    pose = solve_semidefinite(H, coupling)
    stiffness = stiffness - jnp.dot(coupling, pose)
    descent = jnp.dot(pose, b) - ascent
    free = stiffness > 0
    log_scale = jnp.where(free, descent / jnp.where(free, stiffness, 1), 0)
    growth = jnp.exp(jnp.clip(log_scale, -_MOST, _MOST))
    after = eqx.tree_at(
        lambda m: (m.source, m.residual),
        found,
        (growth * found.source, found.residual - (growth - 1) * found.rotated),
    )
    return growth, after


def first_guess(
    source: PointCloud, target: PointCloud, init: Motion | None, with_scale: bool
) -> tuple[Motion, Scalar]:
    """A rigid guess and the scale before it; without one the ratio of the radii."""
    d, dtype = source.points.shape[1], source.points.dtype
    one = jnp.ones((), dtype)
    if init is None:
        if with_scale:
            radius = rms_radius(source.points, source.mask)
            ratio = rms_radius(target.points, target.mask) / radius
            one = jnp.where(radius > 0, ratio, one)
        return lie.identity(d, dtype), one
    if not with_scale:
        return init, one
    block = lie.rotation(init)
    scale = jnp.sqrt(jnp.sum(block * block) / d)
    scale = jnp.where(scale > 0, scale, one)
    return lie.compose(block / scale, lie.translation(init)), scale
