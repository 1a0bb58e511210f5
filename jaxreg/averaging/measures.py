"""Measures of answers that every method uses."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def frobenius(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], scale: Float[Array, ""]
) -> Float[Array, " e"]:
    """|T_i_j - inv(T_world_i) T_world_j|_F with lengths over `scale` (Eq. 22)."""
    rotation, translation = graph.differences(T_world_i)
    sq = rotation + translation / scale**2
    return jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)


def weighted_mean(x: Array, weight: Array) -> Array:
    """The mean of x by weight; 0 where there is no weight."""
    total = jnp.sum(weight)
    return jnp.sum(weight * x) / jnp.where(total > 0, total, 1)


def deviations(graph: PoseGraph, T: Array, trust: Array) -> Float[Array, "2"]:
    """Of one component of a translation and of a rotation, by the trusted edges."""
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    rotation, translation = graph.differences(T)
    w = graph.weight * trust
    count = jnp.sum(jnp.where(graph.mask, trust, 0))
    spare = jnp.maximum(count - (graph.num_poses - 1), 1)
    mean = jnp.stack(
        [
            jnp.sum(w * jnp.where(w > 0, translation, 0)) / d,
            jnp.sum(w * jnp.where(w > 0, rotation, 0)) / (2 * (k - d)),
        ]
    )
    return jnp.maximum(jnp.sqrt(mean / spare), 8 * jnp.finfo(T.dtype).eps)
