"""Shortest paths from one frame, and the poses along them, inside jit.

Of small graphs every edge passes on what it knows, round by round (Bellman and Ford).
Of large ones only frames that have come nearer do (Moore's queue for the same
recursion), `_WINDOW` edges at a time. So the work follows the edges, not edges times
hops: 3 us a frame of a grid, 12 us of a chain, on one core.

By hand: `scipy.sparse.csgraph` runs on the host, outside `jit` and `vmap`.

Gradients: none; inputs are cut, as for `trees`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg.geometry import lie
from jaxreg.graph.trees import follow


# Frames from which on a queue is worth its longer compilation: a chain of as many takes
# rounds for 50 ms.
_LARGE = 4096
# Edges of a step: a step of a chain, which has two, should not do much in vain.
_WINDOW = 64


class Paths(eqx.Module):
    """A tree of shortest paths from one frame, the root.

    Attributes:
        T_root_i: `(v, d+1, d+1)` with the identity at frames that no path reaches.
        reached: `(v,)` True for the frames reached.
        parent: `(v,)` int32 the frame before, the frame itself at the root and where
            none is.
        via: `(v,)` int32 the edge from there, e where none is.
    """

    T_root_i: Float[Array, "v D D"]
    reached: Bool[Array, " v"]
    parent: Int[Array, " v"]
    via: Int[Array, " v"]


def shortest_paths(
    edges: Int[Array, "e 2"],
    T_i_j: Float[Array, "e D D"],
    weight: Float[Array, " e"],
    num_poses: int,
    root: Int[Array, ""] | int = 0,
) -> Paths:
    """The paths from a frame of least total 1 / weight.

    If weights are inverse variances, every frame gets the chain of least variance;
    if they are all equal, this is a breadth-first tree.
    Weights below a thousandth of the largest count as a thousandth.
    """
    edges, T_i_j, weight = jax.lax.stop_gradient((edges, T_i_j, weight))
    i, j = edges[:, 0], edges[:, 1]
    present = weight > 0
    # Lengths from 1 to 1000, so that a step never vanishes in a float32 sum.
    top = jnp.max(jnp.where(present, weight, 0))
    length = jnp.minimum(top / jnp.where(present, weight, 1), 1000)
    length = jnp.where(present, length, jnp.inf)

    how = _in_turn if num_poses > _LARGE else _in_rounds
    reach = how(edges, length, num_poses, root)
    reached = jnp.isfinite(reach)
    # The parent is the best neighbour that is strictly nearer: no cycles by rounding.
    via_i = jnp.where(reach[i] < reach[j], reach[i] + length, jnp.inf)
    via_j = jnp.where(reach[j] < reach[i], reach[j] + length, jnp.inf)
    best = (
        jnp.full((num_poses,), jnp.inf, T_i_j.dtype).at[j].min(via_i).at[i].min(via_j)
    )
    num_edges = edges.shape[0]
    order = jnp.arange(num_edges, dtype=jnp.int32)
    none = 2 * num_edges
    to_j = jnp.where(jnp.isfinite(via_i) & (via_i == best[j]), order, none)
    to_i = jnp.where(jnp.isfinite(via_j) & (via_j == best[i]), order + num_edges, none)
    code = jnp.full((num_poses,), none, jnp.int32).at[j].min(to_j).at[i].min(to_i)
    has = code < none
    backward = code >= num_edges
    e = jnp.where(has, jnp.where(backward, code - num_edges, code), 0)
    frames = jnp.arange(num_poses, dtype=jnp.int32)
    parent = jnp.where(has, jnp.where(backward, j[e], i[e]), frames)
    eye = jnp.eye(T_i_j.shape[-1], dtype=T_i_j.dtype)
    T_parent = jnp.where(backward[:, None, None], lie.inverse(T_i_j[e]), T_i_j[e])
    T_parent = jnp.where(has[:, None, None], T_parent, eye[None])
    via = jnp.where(has, e, num_edges)
    return Paths(follow(parent, T_parent)[1], reached, parent, via)


def _in_rounds(
    edges: Int[Array, "e 2"],
    length: Float[Array, " e"],
    num_poses: int,
    root: Int[Array, ""] | int,
) -> Float[Array, " v"]:
    """The length of the shortest path to each frame; edges of length inf are absent."""
    i, j = edges[:, 0], edges[:, 1]

    def relax(state: tuple[Array, Array]) -> tuple[Array, Array]:
        reach, _ = state
        new = reach.at[j].min(reach[i] + length).at[i].min(reach[j] + length)
        return new, jnp.any(new < reach)

    start = jnp.full((num_poses,), jnp.inf, length.dtype).at[root].set(0)
    return control.while_loop(lambda s: s[1], relax, (start, jnp.asarray(True)))[0]


class _Neighbours(NamedTuple):
    """Edges by the frame that they leave, each in both directions."""

    begin: Int[Array, " v+1"]  # the first of each frame
    frame: Int[Array, " 2e"]  # at the other end
    length: Float[Array, " 2e"]


class _Queue(NamedTuple):
    """Frames that have come nearer and have to tell their neighbours."""

    reach: Float[Array, " v"]  # lengths of the shortest paths so far
    ring: Int[Array, " v+1"]
    head: Int[Array, ""]
    size: Int[Array, ""]
    told: Int[Array, ""]  # neighbours that the frame at the head has told
    waits: Int[Array, " v"]  # above 0 for frames that are in the ring and told none


def _in_turn(
    edges: Int[Array, "e 2"],
    length: Float[Array, " e"],
    num_poses: int,
    root: Int[Array, ""] | int,
) -> Float[Array, " v"]:
    """The same, by a queue."""
    near = _neighbours(edges, length, num_poses)
    one = jnp.asarray(1, jnp.int32)
    start = _Queue(
        reach=jnp.full((num_poses,), jnp.inf, length.dtype).at[root].set(0),
        ring=jnp.zeros((num_poses + 1,), jnp.int32).at[0].set(root),
        head=0 * one,
        size=one,
        told=0 * one,
        waits=jnp.zeros((num_poses,), jnp.int32).at[root].set(1),
    )
    end = control.while_loop(lambda q: q.size > 0, lambda q: _told(q, near), start)
    return end.reach


def _neighbours(edges: Array, length: Array, num_poses: int) -> _Neighbours:
    i, j = edges[:, 0], edges[:, 1]
    both = jnp.concatenate([length, length])
    leaves = jnp.where(jnp.isfinite(both), jnp.concatenate([i, j]), num_poses)
    order = jnp.arange(len(both), dtype=jnp.int32)
    order = jax.lax.sort((leaves, order), num_keys=1)[1]
    degree = jnp.zeros((num_poses + 1,), jnp.int32).at[leaves].add(1)
    begin = jnp.cumsum(degree, dtype=jnp.int32) - degree
    return _Neighbours(begin, jnp.concatenate([j, i])[order], both[order])


def _told(queue: _Queue, near: _Neighbours) -> _Queue:
    """The frames at the head tell as many neighbours as there are places in a step."""
    q, num = queue, len(queue.reach)
    place = jnp.arange(_WINDOW, dtype=jnp.int32)
    frame = q.ring[(q.head + place) % (num + 1)]
    here = place < q.size
    first = near.begin[frame] + jnp.where(place == 0, q.told, 0)
    size = jnp.where(here, near.begin[frame + 1] - first, 0)
    end = jnp.cumsum(size, dtype=jnp.int32)
    done = here & (end <= _WINDOW)
    starts = (done | (here & (end - size < _WINDOW))) & ((place > 0) | (q.told == 0))
    waits = q.waits.at[jnp.where(starts, frame, num)].set(0, mode="drop")
    # Which frame each place belongs to, and which of its edges.
    owner = jnp.searchsorted(end, place, side="right", method="scan_unrolled")
    used = place < end[-1]
    owner = jnp.where(used, owner, 0)
    edge = jnp.where(used, first[owner] + place - (end - size)[owner], 0)
    to = jnp.where(used, near.frame[edge], num)
    offer = q.reach[frame[owner]] + near.length[edge]
    nearer = used & (offer < q.reach[jnp.minimum(to, num - 1)])
    to = jnp.where(nearer, to, num)
    reach = q.reach.at[to].min(offer, mode="drop")
    # Of several places with one new frame the last puts it into the ring.
    new = nearer & (waits[jnp.minimum(to, num - 1)] == 0)
    waits = waits.at[jnp.where(new, to, num)].max(place + 1, mode="drop")
    new = new & (waits[jnp.minimum(to, num - 1)] == place + 1)
    tail = q.head + q.size + jnp.cumsum(new, dtype=jnp.int32) - 1
    slot = jnp.where(new, tail % (num + 1), num + 1)
    gone = jnp.sum(done, dtype=jnp.int32)
    # The next has told some of its neighbours, if places were left for it.
    left = _WINDOW - jnp.where(gone > 0, end[gone - 1], 0)
    told = jnp.where(gone > 0, 0, q.told) + left
    return _Queue(
        reach=reach,
        ring=q.ring.at[slot].set(to, mode="drop"),
        head=(q.head + gone) % (num + 1),
        size=q.size - gone + jnp.sum(new, dtype=jnp.int32),
        told=jnp.where(gone < jnp.minimum(q.size, _WINDOW), told, 0),
        waits=waits,
    )
