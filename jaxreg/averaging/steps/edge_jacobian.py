"""The dense derivative of what edges add to the balance of frames.

In general a dense matrix takes one product for each unknown; an edge moves two frames
only, so a few products do.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def edge_jacobian(
    imbalance: Callable[[PoseGraph, Array], Array],
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
) -> Float[Array, "n n"]:
    """The derivative by left tangents, where an edge adds by its two poses alone.

    Every edge gets two frames of its own, so that 2 k products serve all of them.

    Args:
        imbalance: `(v, k)` at given poses, a sum over edges.
        graph: whose edges they are.
        T_world_i: where the derivative is taken.

    Returns:
        `(v k, v k)`, rows and columns by frame, then by component.
    """
    e, k = graph.num_edges, lie.tangent_dim(graph.dim)
    ends = jnp.arange(2 * e, dtype=graph.edges.dtype).reshape(e, 2)
    apart = dataclasses.replace(graph, edges=ends, num_poses=2 * e)
    T = T_world_i[graph.edges].reshape(2 * e, *T_world_i.shape[1:])
    push = jax.linearize(lambda T: imbalance(apart, T), T)[1]
    still, axes = jnp.zeros((k, k), T.dtype), jnp.eye(k, dtype=T.dtype)
    velocity = jax.jvp(lie.exp, (still,), (axes,))[1][:, None] @ T

    def column(moving: Array, end: Array) -> Array:
        """By one component of the tangents of one end of every edge."""
        return push(jnp.where(jnp.arange(2 * e)[:, None, None] % 2 == end, moving, 0))

    by_axes = jax.vmap(column, in_axes=(0, None))
    blocks = jax.vmap(lambda end: by_axes(velocity, end))(jnp.arange(2))
    blocks = blocks.reshape(2, k, e, 2, k)
    blocks = jnp.transpose(blocks, (2, 3, 4, 0, 1))  # (e, end, k, by end, by k)
    num, at = graph.num_poses, graph.edges
    J = jnp.zeros((num, num, k, k), T.dtype)
    J = J.at[at[:, :, None], at[:, None, :]].add(jnp.swapaxes(blocks, 2, 3))
    return jnp.transpose(J, (0, 2, 1, 3)).reshape(num * k, num * k)
