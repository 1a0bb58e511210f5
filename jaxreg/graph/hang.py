"""Frames that no edge holds, hung on frame 0, so that all of a graph is averaged."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.graph.pose_graph import PoseGraph


# The weight of motions of no consequence: below those of edges, above nothing.
_HUNG = 0.1


def with_hung(
    graph: PoseGraph,
    hung: Bool[Array, " v"],
    T_0_i: Float[Array, "v D D"] | None = None,
) -> PoseGraph:
    """With a motion from frame 0 to each frame of `hung`: none contradicts it.

    Args:
        graph: whose parts are not joined.
        hung: one frame of each part but that of frame 0.
        T_0_i: where they hang; at frame 0 by default.
    """
    num, D = hung.shape[0], graph.T_i_j.shape[-1]
    ids = jnp.where(hung, jnp.arange(num, dtype=jnp.int32), 0)
    eye = jnp.broadcast_to(jnp.eye(D, dtype=graph.T_i_j.dtype), (num, D, D))
    T = eye if T_0_i is None else jnp.where(hung[:, None, None], T_0_i, eye)
    weight = jnp.where(hung, _HUNG, 0).astype(graph.weight.dtype)
    info = graph.information
    if info is not None:
        count = jnp.maximum(jnp.sum(graph.mask), 1)
        mean = jnp.sum(jnp.where(graph.mask[:, None, None], info, 0), axis=0) / count
        more = jnp.where(hung[:, None, None], mean, 0)
        info = jnp.concatenate([info, more])
    return PoseGraph(
        edges=jnp.concatenate(
            [graph.edges, jnp.stack([jnp.zeros_like(ids), ids], axis=1)]
        ),
        T_i_j=jnp.concatenate([graph.T_i_j, T]),
        weight=jnp.concatenate([graph.weight, weight]),
        mask=jnp.concatenate([graph.mask, hung]),
        information=info,
        num_poses=graph.num_poses,
    )
