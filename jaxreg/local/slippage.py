"""Whether two surfaces that agree can slip along each other."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.typing import Motion
from jaxreg.local.problem import Problem, match
from jaxreg.local.residuals import PointToPlane, PointToPoint
from jaxreg.local.score import agreeing


# Planes that the gentlest motion by one radian, or radius, moves less than this many
# radii do not hold a pose. (Right pairs of scans have 0.09 and more; the side of a limb
# that fits another limb 0.02 to 0.06.)
_HELD = 0.07


def can_slip(
    problem: Problem, T_target_source: Motion, spacing: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether some motion leaves the agreeing surfaces nearly in place.

    As a surface of revolution turns in itself, and a plane slides. Their mean squared
    motion is J^T J with J = (n, x cross n), x from their middle; its least eigenvalue
    is that of the gentlest motion (Gelfand, Ikemoto, Rusinkiewicz, Levoy:
    Geometrically stable sampling for the ICP algorithm, 2003).

    Args:
        problem: in frames whose unit is the radius of the clouds. Points that have no
            normals hold every direction.
        T_target_source: the pose.
        spacing: distance between samples of the coarser cloud.
    """
    found = match(problem, T_target_source)
    share = agreeing(found, spacing)
    weight = share / jnp.maximum(jnp.sum(share), 1).astype(spacing.dtype)
    middle = jnp.sum(weight * found.rotated, axis=1)
    found = eqx.tree_at(lambda m: m.rotated, found, found.rotated - middle[:, None])
    flat = jnp.any(found.normal != 0, axis=0)
    H, _ = PointToPlane(0.0).normal_equations(found, weight * flat)
    H = H + PointToPoint().normal_equations(found, weight * ~flat)[0]
    return jnp.linalg.eigvalsh(H)[0] < _HELD**2
