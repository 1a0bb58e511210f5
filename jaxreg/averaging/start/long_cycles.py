"""Evidence for edges from long cycles: those that trees of short paths close.

Graphs of few edges a frame have few cycles of three, but many longer ones. A tree of
shortest paths closes one with each of the other edges. Random wrong motions hardly ever
close a cycle, however long, so one that closes speaks for all of its edges; and some of
the trees of many frames lead around the wrong edges.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Key
from jaxreg.averaging.base import length_scale
from jaxreg.averaging.evidence import squared_errors
from jaxreg.averaging.start.cycles import NEUTRAL
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


# Trees that are grown; how far their paths are turned off the shortest, in lengths of
# an edge.
_TREES, _DETOUR = 32, 1.0
# Cycles that close as much as speak for nothing.
_NOTHING = 0.1


def long_cycle_odds(
    graph: PoseGraph, odds: Float[Array, " e"], key: Key
) -> Float[Array, "s e"]:
    """The logarithm of the odds that each edge is right, judged by long cycles.

    One row for each closing error of `NEUTRAL`: the logarithm of the number of cycles
    that close at least as well, positive from one on. -inf for edges of weight 0.

    Args:
        graph: of moderate size: takes memory of edges times frames.
        odds: what is known of the edges; paths keep to those that are likely.
        key: of the frames that trees begin at, and of their detours.

    Gradients: none.
    """
    present = graph.weight > 0
    doubt = jnp.clip(jax.nn.softplus(-odds), 0.01, 10)

    def grown(key: Key) -> Array:
        return _closed_cycles(graph, doubt, key)

    keys = jax.random.split(key, _TREES)
    counts = jax.lax.map(grown, keys)
    closed = jnp.log(jnp.sum(counts, axis=0) + _NOTHING)
    return jnp.where(present, closed, -jnp.inf)


def _closed_cycles(
    graph: PoseGraph, doubt: Float[Array, " e"], key: Key
) -> Float[Array, "s e"]:
    """The number of closing cycles of one tree that each edge is part of."""
    begin, turn = jax.random.split(key)
    root = jax.random.randint(begin, (), 0, graph.num_poses)
    detour = jax.random.exponential(turn, doubt.shape, doubt.dtype)
    length = doubt + _DETOUR * jnp.mean(doubt) * detour
    weight = jnp.where(graph.weight > 0, 1 / length, 0)
    paths = trees.shortest_paths(
        graph.edges, graph.T_i_j, weight, graph.num_poses, root
    )
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    in_tree = jnp.zeros(doubt.shape, bool).at[paths.via].set(True, mode="drop")
    closing = (graph.weight > 0) & ~in_tree & paths.reached[i]
    sq = squared_errors(graph, paths.T_root_i, length_scale(graph))
    neutral = jnp.asarray(NEUTRAL, sq.dtype)[:, None]
    closed = (closing & (sq < neutral**2)).astype(sq.dtype)
    # The edge to a frame is on the path between i and j if one of them lies beyond.
    above = trees.ancestors(paths.parent)
    around = (above[i] != above[j]).astype(sq.dtype)
    return closed.at[:, paths.via].add(closed @ around, mode="drop")
