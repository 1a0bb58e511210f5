"""Which edges are near, as poses place them: registration fails for views far apart."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import DENSE_LIMIT


# Neighbours t that may be near. With 2 as well, sparse graphs agree by chance.
_NEAREST = (4, 8)


def near_ways(
    graph: PoseGraph,
    T_i_j: Float[Array, "e D D"],
    scale: Float[Array, ""],
    laws: tuple[bool, ...],
) -> tuple[Bool[Array, "t e"], Bool[Array, "l t"]]:
    """Whether an edge is near in each way, and which ways each law may mean.

    A law (see `Likelihood`) is told by whether its wrong motions are alone. Successive
    numbers say what is near if most edges are the steps of a sequence. Of more than
    `DENSE_LIMIT` frames drift tells false closures, and this would count it against
    right ones: a path that nothing bends holds all its steps exactly.
    """
    near = _among_nearest(graph, T_i_j, scale)
    meant = jnp.ones((len(laws), len(near)), bool)
    if all(laws) or graph.num_poses > DENSE_LIMIT:
        return near, meant
    present = graph.weight > 0
    sequence = 2 * jnp.sum(graph.successive & present) > jnp.sum(present)
    ways = jnp.concatenate([near, graph.successive[None]])
    also = sequence & ~np.asarray(laws)
    return ways, jnp.concatenate([meant, also[:, None]], axis=1)


def _among_nearest(
    graph: PoseGraph, T_i_j: Float[Array, "e D D"], scale: Float[Array, ""]
) -> Bool[Array, "t e"]:
    """Whether one end of an edge is among the t nearest measured neighbours of another.

    For each t of `_NEAREST`. Nearness is that of the poses, which make T_i_j of the
    motions: squared angle (chordal) and squared length over `scale`. Edges as near as
    each other are so alike.
    """
    far = graph.dim - jnp.trace(lie.rotation(T_i_j), axis1=-2, axis2=-1)
    shift = jnp.sum(lie.translation(T_i_j) ** 2, axis=-1) / scale**2
    far = jnp.where(graph.weight > 0, far + shift, jnp.inf)
    ends = graph.edges.T
    frame, ascending = jax.lax.sort(
        (ends.reshape(-1), jnp.concatenate([far, far])), num_keys=2
    )
    place = jnp.arange(len(frame), dtype=jnp.int32)
    first = jnp.full(graph.num_poses, len(frame), jnp.int32).at[frame].min(place)
    # The t-th nearest of each frame; all are near where there are fewer.
    last = first[None] + jnp.asarray(_NEAREST, jnp.int32)[:, None] - 1
    there = jnp.minimum(last, len(frame) - 1)
    own = frame[there] == jnp.arange(graph.num_poses)[None]
    bound = jnp.where(own & (last < len(frame)), ascending[there], jnp.inf)
    # Compilers compute a distance more than once, not always to the same last digit.
    bound = bound + 16 * jnp.finfo(bound.dtype).eps * (1 + bound)
    return jnp.any(far[None, None] <= bound[:, ends], axis=1)
