"""Measures of graphs that every method uses: lengths, counts, means, middles."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def length_scale(graph: PoseGraph) -> Float[Array, ""]:
    """The length that stands for one radian: the mean |t_i_j| of the middle half.

    It comes from the data, so that another unit of length gives the same answer.
    Half of the edges may be wrong without moving it far. 1 if there is no length.
    """
    length = jnp.linalg.norm(
        lie.translation(jax.lax.stop_gradient(graph.T_i_j)), axis=-1
    )
    valid = graph.weight > 0
    low, high = (
        nearest_rank(length, valid, 0.25),
        nearest_rank(length, valid, 0.75),
    )
    middle = valid & (length >= low) & (length <= high)
    count = jnp.maximum(jnp.sum(middle), 1).astype(length.dtype)
    mean = jnp.sum(jnp.where(middle, length, 0)) / count
    return jnp.where(mean > 0, mean, 1)


def num_held(graph: PoseGraph) -> Float[Array, ""]:
    """The number of frames that edges hold, at least one; padding is not held."""
    w = graph.weight
    held = jnp.zeros((graph.num_poses,), w.dtype)
    held = held.at[graph.edges[:, 0]].max(w).at[graph.edges[:, 1]].max(w)
    return jnp.maximum(jnp.sum(held > 0, dtype=w.dtype), 1)


def nearest_rank(
    x: Float[Array, " e"], mask: Bool[Array, " e"], q: float | Array
) -> Float[Array, ""]:
    """The value of `x[mask]` at quantile q (nearest rank); 0 if the mask is empty."""
    count = jnp.sum(mask)
    rank = jnp.floor(q * (count - 1).astype(x.dtype) + 0.5).astype(jnp.int32)
    value = jnp.sort(jnp.where(mask, x, jnp.inf))[jnp.maximum(rank, 0)]
    return jnp.where(count > 0, value, 0)


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
