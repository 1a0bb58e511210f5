"""Which pairs of scans to register: of few all, of many those that settle something.

Of V scans at most `most_pairs(V)` pairs are registered. The first join each scan to a
few others, those that look alike where that is known; what they say of the poses then
tells which come next:

    parts that are not joined yet    pairs from one to another
    scans that hang by a thread      the pair that overlaps most by the poses
    loops                            pairs that overlap, but are far apart along pairs

Runs on the host, with random numbers of the caller's key: the same key gives the same
pairs.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxreg.graph.hops import hops
from jaxreg.multiview.similar_scans import most_alike


Order = Literal["any", "sequential"]

#: Up to so many scans all pairs may be registered; of more, so many pairs a scan.
ALL_UP_TO, _PAIRS_PER_SCAN = 20, 10
# Up to so many scans all pairs are registered at once, though it is known which look
# alike: there is little to choose from.
_FEW = 6
# Partners of each scan in a first round, in the given order and in a random one.
_IN_ORDER, _AT_RANDOM = 2, 3
# Where it is known which look alike: in the given order, the most alike, and at random
# one of so many that are, of few scans one of a third. Of 100 views of an object these
# pairs were all found, of 60 of a room two in three.
_NEXT, _ALIKE = 1, 24
# Tries of a part that is not joined, a scan and round, and draws for them: a part is at
# most half of all, and few of its pairs with others were tried. As many are looked at
# where it is known which look alike.
_TRIES, _DRAWS = 3, 64
#: A scan is safe by so many trusted pairs; a loop has so many pairs or more.
SAFE, _LOOP = 3, 4
# Longer loops are as good as one of so many pairs.
_LONG = 32
#: Scans are taken to overlap by the poses from this share on; loops are closed by such
#: that share more: a search of less finds one pair in seven.
LIKELY, _CLOSING = 0.2, 0.3


def most_pairs(num_scans: int) -> int:
    """Pairs registered at most: every one of up to 20 scans, ten times V of more."""
    every = num_scans * (num_scans - 1) // 2
    return every if num_scans <= ALL_UP_TO else min(every, _PAIRS_PER_SCAN * num_scans)


def most_tries(num_scans: Int[Array, ""] | int) -> Int[Array, ""]:
    """Pairs of one scan, at most, of many scans on average."""
    every = jnp.maximum(num_scans - 1, 1)
    few = num_scans <= ALL_UP_TO
    return jnp.where(few, every, jnp.minimum(every, 2 * _PAIRS_PER_SCAN))


def all_pairs(num_scans: int) -> np.ndarray:
    """Every pair i < j once, `(e, 2)` int32."""
    return np.stack(np.triu_indices(num_scans, 1), axis=1).astype(np.int32)


def first_pairs(
    num_scans: int,
    order: Order,
    rng: np.random.Generator,
    words: np.ndarray | None = None,
    since: int = 0,
) -> np.ndarray:
    """The pairs of the first round, `(e, 2)` int32 in ascending order.

    Args:
        num_scans: V.
        order: "sequential" if scans next to each other overlap: these pairs alone, as
            far as there are many; "any": those and pairs that look alike, or at random.
        rng: of the caller.
        words: `(v, w)` of scans that look alike (`words_of`), or None.
        since: the first scan that is new; pairs of two before it are left out.
    """
    few = ALL_UP_TO if words is None else _FEW
    if num_scans <= few and order == "any":
        every = all_pairs(num_scans)
        return every[every[:, 1] >= since]
    ids = np.arange(num_scans)
    chosen = [(ids[:-step], ids[step:]) for step in range(1, _IN_ORDER + 1)]
    if order == "any" and words is not None:
        new = ids[since:]
        near = most_alike(words, min(_ALIKE, max(num_scans // 3, 2)), rows=new)
        one_of = rng.permuted(near[:, 1:], axis=1)[:, 0]
        chosen = [*chosen[:_NEXT], (new, near[:, 0]), (new, one_of)]
    elif order == "any":
        ring = rng.permutation(num_scans)
        chosen += [(ring, np.roll(ring, step)) for step in range(1, _AT_RANDOM + 1)]
    every = ascending(np.concatenate([np.stack(x, axis=1) for x in chosen]))
    return every[every[:, 1] >= since]


def next_pairs(
    tried: np.ndarray,
    trusted: np.ndarray,
    near: np.ndarray,
    overlap: np.ndarray,
    part: np.ndarray,
    rng: np.random.Generator,
    words: np.ndarray | None = None,
) -> np.ndarray:
    """The pairs of a later round, `(e, 2)` int32; none where nothing is left to settle.

    Args:
        tried: `(t, 2)` the pairs i < j that were registered.
        trusted: `(t,)` which of them are trusted.
        near: `(c, 2)` pairs i < j that may overlap by the present poses.
        overlap: `(c,)` how much they do.
        part: `(v,)` which scans hang together.
        rng: of the caller.
        words: as in `first_pairs`.
    """
    num = len(part)
    done = pair_keys(tried, num)
    chosen = [_joining(done, part, rng, words)]
    open_ = ~np.isin(pair_keys(near, num), done) & (overlap >= LIKELY)
    open_ &= part[near[:, 0]] == np.bincount(part).argmax()
    both = np.concatenate([near[open_], near[open_][:, ::-1]])
    worth = np.tile(overlap[open_], 2)
    between = hops(tried[trusted], both, num, _LONG)
    few = np.bincount(tried[trusted].ravel(), minlength=num) < SAFE
    far = (between >= _LOOP) & (worth >= _CLOSING)
    for value in (worth * between * far, worth * few[both[:, 0]]):
        chosen.append(_best_of_each(both, value))
    return ascending(np.concatenate(chosen))


def pair_keys(pairs: np.ndarray, num_scans: int) -> np.ndarray:
    """`(e,)` int64, one number for each pair i < j; of any leading shape."""
    return pairs[..., 0].astype(np.int64) * num_scans + pairs[..., 1]


def ascending(pairs: np.ndarray) -> np.ndarray:
    """Each pair once, as i < j, sorted; `(e, 2)` int32."""
    low, high = np.minimum(*pairs.T).astype(np.int64), np.maximum(*pairs.T)
    num = int(high.max(initial=0)) + 1
    # `np.unique` hashes, which takes ten times as long.
    keys = np.sort((low * num + high)[low != high])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack(np.divmod(keys, num), axis=1).astype(np.int32)


def _joining(
    done: np.ndarray,
    part: np.ndarray,
    rng: np.random.Generator,
    words: np.ndarray | None,
) -> np.ndarray:
    """From each scan outside of the largest part some pairs with other parts.

    The most alike that were not tried, where that is known; else drawn.
    """
    num = len(part)
    rows = np.flatnonzero(part != np.bincount(part).argmax())
    if not len(rows):
        return np.zeros((0, 2), int)
    if words is None:
        others = np.array([rng.permutation(num)[:_DRAWS] for _ in rows])
    else:
        others = most_alike(words, min(_DRAWS, num), part, rows)
    one = np.broadcast_to(rows[:, None], others.shape)
    both = np.stack([np.minimum(one, others), np.maximum(one, others)], axis=-1)
    new = ~np.isin(pair_keys(both, num), done) & (part[one] != part[others])
    return both[new & (np.cumsum(new, axis=1) <= _TRIES)]


def _best_of_each(pairs: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Of each first scan the pair of largest value, if that is above zero."""
    pairs, value = pairs[value > 0], value[value > 0]
    order = np.lexsort((pairs[:, 1], -value, pairs[:, 0]))
    _, first = np.unique(pairs[order, 0], return_index=True)
    return pairs[order][first]
