"""Which pairs of scans to register: of few all, of many those that settle something.

Of V scans at most `most_pairs(V)` pairs are registered. The first join each scan to a
few others; what they say of the poses then tells which come next:

    parts that are not joined yet    pairs from one to another
    scans that hang by a thread      the pair that overlaps most by the poses
    loops                            pairs that overlap, but are far apart along pairs

Runs on the host, with random numbers of the caller's key: the same key gives the same
pairs.
"""

from typing import Literal

import numpy as np
from scipy.sparse.csgraph import shortest_path


Order = Literal["any", "sequential"]

#: Up to so many scans all pairs are registered; of more, so many pairs a scan.
ALL_UP_TO, _PAIRS_PER_SCAN = 20, 10
# Partners of each scan in a first round, in the given order and in a random one.
_IN_ORDER, _AT_RANDOM = 2, 3
# Tries of a part that is not joined, a scan and round.
_TRIES = 3
#: A scan is safe by so many trusted pairs; a loop has so many pairs or more.
SAFE, _LOOP = 3, 4
#: Scans are taken to overlap by the poses from this share on.
LIKELY = 0.2


def most_pairs(num_scans: int) -> int:
    """Pairs registered at most: all of up to 20 scans, ten times V of more."""
    every = num_scans * (num_scans - 1) // 2
    return every if num_scans <= ALL_UP_TO else min(every, _PAIRS_PER_SCAN * num_scans)


def all_pairs(num_scans: int) -> np.ndarray:
    """Every pair i < j once, `(e, 2)` int32."""
    return np.stack(np.triu_indices(num_scans, 1), axis=1).astype(np.int32)


def first_pairs(num_scans: int, order: Order, rng: np.random.Generator) -> np.ndarray:
    """The pairs of the first round, `(e, 2)` int32 in ascending order.

    Args:
        num_scans: V.
        order: "sequential" if scans next to each other overlap: these pairs alone, as
            far as there are many; "any": those and pairs at random.
        rng: of the caller.
    """
    if num_scans <= ALL_UP_TO and order == "any":
        return all_pairs(num_scans)
    chosen = np.zeros((num_scans, num_scans), bool)
    for step in range(1, _IN_ORDER + 1):
        chosen[np.arange(num_scans - step), np.arange(step, num_scans)] = True
    if order == "any":
        ring = rng.permutation(num_scans)
        for step in range(1, _AT_RANDOM + 1):
            chosen[ring, np.roll(ring, step)] = True
    return _ascending(chosen)


def next_pairs(
    tried: np.ndarray,
    trusted: np.ndarray,
    likely: np.ndarray,
    part: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """The pairs of a later round, `(e, 2)` int32; none where nothing is left to settle.

    Args:
        tried: `(v, v)` symmetric, the pairs that were registered.
        trusted: `(v, v)` symmetric, those of them that are trusted.
        likely: `(v, v)` symmetric, overlap by the present poses, 0 where not known.
        part: `(v,)` which scans hang together.
        rng: of the caller.
    """
    num = len(tried)
    open_ = ~tried & ~np.eye(num, dtype=bool)
    chosen = np.zeros((num, num), bool)
    largest = np.bincount(part).argmax()
    for i in np.flatnonzero(part != largest):
        others = np.flatnonzero(open_[i] & (part != part[i]))
        chosen[i, rng.permutation(others)[:_TRIES]] = True
    overlap = np.where(open_ & (likely >= LIKELY), likely, 0)
    hops = shortest_path(trusted, unweighted=True)
    loop = np.where(hops >= _LOOP, overlap * np.minimum(hops, num), 0)
    weak = np.sum(trusted, axis=1) < SAFE
    for i in np.flatnonzero(part == largest):
        for worth in (loop[i], overlap[i] * weak[i]):
            if worth.max() > 0:
                chosen[i, worth.argmax()] = True
    return _ascending(chosen)


def _ascending(chosen: np.ndarray) -> np.ndarray:
    pairs = np.argwhere(np.triu(chosen | chosen.T, 1))
    return pairs.astype(np.int32)
