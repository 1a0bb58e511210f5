"""Graphs of aggregates: frames paired along their strongest edges, three times over.

All sizes are static: an eighth of the frames, and at most a quarter of the edges.
Loops run over edges as scatters; nothing is sorted but the edges, once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control


_PAIRINGS, _OFFERS = 3, 4
#: Frames over aggregates, and edges over those that stay between aggregates at most.
RATIO, _EDGES = 2**_PAIRINGS, 4


class Aggregates(NamedTuple):
    """A graph of aggregates, and how the finer one maps onto it."""

    parent: Int[Array, " v"]  # aggregate of each frame
    edges: Int[Array, "c 2"]  # between aggregates; (0, 0) where there is none
    slot: Int[Array, " e"]  # row of `edges` of each finer edge; c within aggregates
    lost: Bool[Array, " e"]  # between aggregates, but found no room


def aggregate(
    edges: Int[Array, "e 2"], strength: Float[Array, " e"], num: int
) -> Aggregates:
    """Pairs frames, pairs of frames, and pairs of those.

    Frames must be of a few strong edges each for the aggregates to be of even size;
    others, and frames without edges, cost quality alone.

    Args:
        edges: `(e, 2)` frames.
        strength: `(e,)` at least 0; edges of strength 0 join nothing.
        num: number of frames.
    """
    i, j = edges[:, 0], edges[:, 1]

    def pair(_: Array, label: Array) -> Array:
        return _paired(label[i], label[j], strength, num)[label]

    frames = jnp.arange(num, dtype=jnp.int32)
    label = control.fori_loop(0, _PAIRINGS, pair, frames)
    count = -(-num // RATIO)
    reached = jnp.zeros((num,), bool).at[i].max(strength > 0).at[j].max(strength > 0)
    root = (label == frames) & reached
    # Aggregates beyond the room share that of others.
    parent = ((jnp.cumsum(root, dtype=jnp.int32) - 1) % count)[label]
    return _between(parent, edges, strength, count)


def _paired(i: Array, j: Array, strength: Array, num: int) -> Int[Array, " v"]:
    """The smaller frame of the pair of each frame; lone ones join a pair next to them.

    Both ends of an edge must hold it for their best: a few rounds pair nearly all.
    """
    strength, chance = _together(i, j, jnp.where(i != j, strength, 0))
    degree = jnp.zeros((num,), strength.dtype).at[i].add(strength).at[j].add(strength)
    both = jnp.where(strength > 0, degree[i] * degree[j], 1)
    wish = strength * jax.lax.rsqrt(both) * (1 + 0.1 * chance)
    frames = jnp.arange(num, dtype=jnp.int32)

    def best(at_i: Array, at_j: Array) -> Array:
        return jnp.zeros((num,), wish.dtype).at[i].max(at_i).at[j].max(at_j)

    def offer(_: Array, mate: Array) -> Array:
        free = mate == frames
        w = jnp.where(free[i] & free[j], wish, 0)
        top = best(w, w)
        agreed = (w > 0) & (w == top[i]) & (w == top[j])
        mate = mate.at[jnp.where(agreed, i, num)].set(j, mode="drop")
        return mate.at[jnp.where(agreed, j, num)].set(i, mode="drop")

    mate = control.fori_loop(0, _OFFERS, offer, frames)
    root, free = jnp.minimum(frames, mate), mate == frames
    to_j = jnp.where(free[i] & ~free[j], wish, 0)
    to_i = jnp.where(free[j] & ~free[i], wish, 0)
    top = best(to_j, to_i)
    joins_j = jnp.where((to_j > 0) & (to_j == top[i]), i, num)
    joins_i = jnp.where((to_i > 0) & (to_i == top[j]), j, num)
    joined = root.at[joins_j].set(root[j], mode="drop")
    return joined.at[joins_i].set(root[i], mode="drop")


def _together(i: Array, j: Array, strength: Array) -> tuple[Array, Array]:
    """The sum over parallel edges, and a number in [0, 1) to break ties.

    The few other edges in the same bucket do no harm.
    """
    code, size = _code(i, j), 2 * strength.shape[0]
    bucket = (code % size).astype(jnp.int32)
    total = jnp.zeros((size,), strength.dtype).at[bucket].add(strength)[bucket]
    chance = (code >> 8).astype(strength.dtype) / 2**24
    return jnp.where(strength > 0, total, 0), chance


def _code(i: Array, j: Array) -> Array:
    """32 mixed bits of each unordered pair."""
    low = jnp.minimum(i, j).astype(jnp.uint32)
    x = low * jnp.uint32(0x9E3779B1) ^ jnp.maximum(i, j).astype(jnp.uint32)
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    return x ^ (x >> 16)


def _between(parent: Array, edges: Array, strength: Array, count: int) -> Aggregates:
    """Edges between aggregates, parallel ones merged; weak ones may find no room."""
    num_edges = edges.shape[0]
    room = max(1, min(-(-num_edges // _EDGES), count * (count - 1) // 2))
    low = jnp.min(parent[edges], axis=1)
    high = jnp.max(parent[edges], axis=1)
    crossing = (strength > 0) & (low < high)
    # The strong first, by powers of eight, and those of a kind in no order, so that
    # those that find no room are weak and spread over the graph.
    total, _ = _together(low, high, jnp.where(crossing, strength, 0))
    power = jnp.clip(-jnp.log2(jnp.where(crossing, total, 1)) / 3, 0, 7)
    code = power.astype(jnp.uint32) << 29 | _code(low, high) >> 3
    code = jnp.where(crossing, code, jnp.uint32(0xFFFFFFFF))
    order = jnp.arange(num_edges, dtype=jnp.int32)
    order = jax.lax.sort((code, order), num_keys=1)[1]
    low_, high_ = low[order], high[order]
    same = (low_[1:] == low_[:-1]) & (high_[1:] == high_[:-1])
    new = crossing[order] & jnp.append(True, ~same)
    row = jnp.cumsum(new, dtype=jnp.int32) - 1
    slot = jnp.zeros((num_edges,), jnp.int32).at[order].set(row)
    lost = crossing & (slot >= room)
    slot = jnp.where(crossing, jnp.minimum(slot, room), room)
    coarse = jnp.zeros((room, 2), jnp.int32)
    coarse = coarse.at[slot].set(jnp.stack([low, high], axis=1), mode="drop")
    return Aggregates(parent, coarse, slot, lost)
