"""Components, spanning trees and the poses along them, inside jit.

All functions take `edges` and a weight per edge; edges of weight 0 (or NaN) are
absent. Every loop takes O(e) work a round; the rounds are logarithmic in the number of
frames.

By hand: `scipy.sparse.csgraph` runs on the host, outside `jit` and `vmap`.

Gradients: none; inputs are cut (the topology is not differentiable, and the poses of
a tree serve as a start).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import rows_of
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import product


class Forest(eqx.Module):
    """A spanning tree of each component, with poses chained along it.

    Attributes:
        T_world_i: `(v, d+1, d+1)` poses with frame 0 at the identity; the identity for
            frames that are not reached.
        reached: `(v,)` True for the frames of the component of frame 0.
        component: `(v,)` int32, equal for frames of the same component.
        in_tree: `(e,)` True for the edges of the forest.
    """

    T_world_i: Float[Array, "v D D"]
    reached: Bool[Array, " v"]
    component: Int[Array, " v"]
    in_tree: Bool[Array, " e"]


def components(
    edges: Int[Array, "e 2"], weight: Float[Array, " e"], num_poses: int
) -> Int[Array, " v"]:
    """The smallest frame id of each frame's component.

    Labels spread along edges and are then followed to their own label (pointer
    jumping), so that long chains take a logarithmic number of rounds.
    """
    present = (weight > 0)[:, None]

    def spread(state: tuple[Array, Array]) -> tuple[Array, Array]:
        label, _ = state
        ends = rows_of(label, edges)
        low = jnp.where(present, jnp.min(ends, axis=1, keepdims=True), num_poses)
        new = label.at[ends].min(jnp.broadcast_to(low, ends.shape))
        new = new[new]
        return new[new], jnp.any(new != label)

    start = jnp.arange(num_poses, dtype=jnp.int32)
    return control.while_loop(lambda s: s[1], spread, (start, jnp.asarray(True)))[0]


class _Boruvka(NamedTuple):
    component: Array
    T_root_i: Array
    in_tree: Array
    joined: Array


def maximum_spanning_tree(
    edges: Int[Array, "e 2"],
    T_i_j: Float[Array, "e D D"],
    weight: Float[Array, " e"],
    num_poses: int,
) -> Forest:
    """The spanning forest of greatest total weight, ties to the earlier edge.

    Boruvka: every component takes its best outgoing edge, in each of at most log2(v)
    rounds. Each frame carries its pose in the frame of its component's root, so the
    poses come with the tree, and products are only as long as the rounds.
    """
    edges, T_i_j, weight = jax.lax.stop_gradient((edges, T_i_j, weight))
    frames = jnp.arange(num_poses, dtype=jnp.int32)
    start = _Boruvka(
        component=frames,
        T_root_i=lie.identity(T_i_j.shape[-1] - 1, T_i_j.dtype, (num_poses,)),
        in_tree=jnp.zeros(weight.shape, dtype=bool),
        joined=jnp.asarray(True),
    )
    end = control.while_loop(
        lambda s: s.joined,
        lambda s: _join_components(s, edges, T_i_j, weight),
        start,
    )
    reached = end.component == end.component[0]
    T_world_i = lie.between(end.T_root_i[0], end.T_root_i)
    eye = jnp.eye(T_i_j.shape[-1], dtype=T_i_j.dtype)
    T_world_i = jnp.where(reached[:, None, None], T_world_i, eye[None]).at[0].set(eye)
    return Forest(T_world_i, reached, end.component, end.in_tree)


def _join_components(
    state: _Boruvka, edges: Array, T_i_j: Array, weight: Array
) -> _Boruvka:
    """One round: each component hooks onto another through its best edge."""
    num_poses, num_edges = state.component.shape[0], edges.shape[0]
    ends = rows_of(state.component, edges)  # components, (e, 2)
    leaving = ((ends[:, 0] != ends[:, 1]) & (weight > 0))[:, None]
    w = jnp.broadcast_to(jnp.where(leaving, weight[:, None], 0), ends.shape)
    best_weight = jnp.zeros((num_poses,), w.dtype).at[ends].max(w)
    order = jnp.arange(num_edges, dtype=jnp.int32)[:, None]
    first = jnp.where(leaving & (w == rows_of(best_weight, ends)), order, num_edges)
    best = jnp.full((num_poses,), num_edges, jnp.int32).at[ends].min(first)
    found = best < num_edges
    e = jnp.where(found, best, 0)
    frames = jnp.arange(num_poses, dtype=jnp.int32)
    own, across = jnp.unstack(rows_of(ends, e), axis=1)
    outward = own == frames
    other = jnp.where(outward, across, own)
    # Of two components that chose the same edge, the smaller id becomes the root.
    mutual = found & found[other] & (best[other] == best) & (frames < other)
    hooks = found & ~mutual
    parent = jnp.where(hooks, other, frames)
    X_i, X_j = jnp.unstack(rows_of(state.T_root_i, rows_of(edges, e)), axis=1)
    T_ri_rj = product(product(X_i, rows_of(T_i_j, e)), lie.inverse(X_j))
    T_parent_c = jnp.where(outward[:, None, None], lie.inverse(T_ri_rj), T_ri_rj)
    eye = jnp.eye(T_i_j.shape[-1], dtype=T_i_j.dtype)
    T_parent_c = jnp.where(hooks[:, None, None], T_parent_c, eye[None])
    root, T_top_c = follow(parent, T_parent_c)
    in_tree = state.in_tree.at[jnp.where(hooks, best, num_edges)].set(True, mode="drop")
    return _Boruvka(
        rows_of(root, state.component),
        product(rows_of(T_top_c, state.component), state.T_root_i),
        in_tree,
        jnp.any(hooks),
    )


def follow(
    parent: Int[Array, " v"], T_parent_i: Float[Array, "v D D"]
) -> tuple[Int[Array, " v"], Float[Array, "v D D"]]:
    """Roots and poses in the frame of the root, by pointer doubling.

    Args:
        parent: the parent of each frame; roots are their own parent.
        T_parent_i: the pose in the parent's frame; the identity at roots.
    """

    def jump(state: tuple[Array, Array]) -> tuple[Array, Array]:
        up, T = state
        return rows_of(up, up), product(rows_of(T, up), T)

    def unfinished(state: tuple[Array, Array]) -> Array:
        return jnp.any(state[0] != state[0][state[0]])

    return control.while_loop(unfinished, jump, (parent, T_parent_i))


def ancestors(parent: Int[Array, " v"]) -> Bool[Array, "v v"]:
    """Row i: frame i and those above it; a root is its own parent."""
    num = parent.shape[0]
    above = jnp.eye(num, dtype=bool)
    for _ in range(max(num - 1, 1).bit_length()):
        above, parent = above | above[parent], parent[parent]
    return above


def along_frames(graph: PoseGraph) -> Float[Array, "v D D"]:
    """Poses along the edges between successive frames, and others where none is.

    Large graphs are sequences as a rule, and a recording seldom slips between one
    frame and the next, while closures of loops may be false.
    """
    more = graph.weight + jnp.max(graph.weight)
    weight = jnp.where((graph.weight > 0) & graph.successive, more, graph.weight)
    return maximum_spanning_tree(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    ).T_world_i
