"""Which pairs of placed scans are worth another look: of a few scans all of them.

Of many scans the pairs that placed them, and each scan with a few that overlap it:
a number that grows with the scans and not with their square.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg.graph.joined import joined
from jaxreg.multiview.choose_pairs import ALL_UP_TO, LIKELY, all_pairs
from jaxreg.multiview.likely_overlap import LikelyOverlap, NearPairs, likely_overlap
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import joins


# Partners of a scan beside those that placed it, drawn among those that overlap it: the
# nearest tell less, as chains of them drift.
_PARTNERS = 16


def near_pairs(
    scans: PreparedScans,
    placement: Placement,
    motions: RelativeMotions,
    likely: LikelyOverlap | None = None,
) -> Int[Array, "p 2"]:
    """Scans i <= j; the pairs of a scan and itself are padding, and come last.

    Args:
        scans: prepared scans.
        placement: their poses, by the motions.
        motions: those that were averaged.
        likely: what is known of overlaps; None under `jit`.
    """
    every = all_pairs(scans.num_scans)
    if likely is not None:
        if scans.num_present > ALL_UP_TO:
            return _chosen(likely.of(placement).padded(), placement, motions.pairs)
        there = all_pairs(scans.num_present)
        padding = np.zeros((len(every) - len(there), 2), np.int32)
        return jax.device_put(np.concatenate([there, padding]))
    pairs = jnp.asarray(every)
    if scans.num_scans <= ALL_UP_TO:
        return pairs
    near = NearPairs(pairs, likely_overlap(scans, placement, pairs))
    return _chosen(near, placement, motions.pairs)


@kept_program
def _chosen(
    near: NearPairs, placement: Placement, tried: Int[Array, "e 2"]
) -> Int[Array, "p 2"]:
    num = placement.part.shape[0]
    drawn = _drawn(near, num)
    used = joins(placement.edge_weight) & (tried[:, 0] != tried[:, 1])
    pairs = jnp.concatenate([near.pairs, tried]).astype(jnp.int32)
    present = jnp.concatenate([drawn, used])
    same = joined(jnp.where(present[:, None], pairs, num))
    size = min(len(tried) + _PARTNERS * num, num * (num - 1) // 2)
    (row,) = jnp.nonzero(present & same.first, size=size, fill_value=len(pairs))
    pairs = jnp.pad(jnp.sort(pairs, axis=1), ((0, 1), (0, 0)))[row]
    # In ascending order, padding last.
    real = pairs[:, 0] != pairs[:, 1]
    return pairs[jnp.lexsort((pairs[:, 1], pairs[:, 0], ~real))]


def _drawn(near: NearPairs, num_scans: int) -> Bool[Array, " c"]:
    """The pairs that are among the first drawn of either scan."""
    key = jax.random.key(0)

    def draw(pair: Int[Array, "2"]) -> Float[Array, ""]:
        own = jax.random.fold_in(jax.random.fold_in(key, pair[0]), pair[1])
        return jax.random.uniform(own, (), near.overlap.dtype)

    i, j = near.pairs[:, 0], near.pairs[:, 1]
    use = (near.overlap >= LIKELY) & (i != j)
    value = jax.vmap(draw)(near.pairs)
    scan = jnp.where(jnp.tile(use, 2), jnp.concatenate([i, j]), num_scans)
    order = jnp.lexsort((-jnp.tile(value, 2), scan))
    begin = jnp.searchsorted(scan[order], jnp.arange(num_scans))
    place = jnp.arange(len(order)) - jnp.append(begin, 0)[scan[order]]
    among = jnp.zeros(len(order), bool).at[order].set(place < _PARTNERS)
    return use & (among[: len(i)] | among[len(i) :])
