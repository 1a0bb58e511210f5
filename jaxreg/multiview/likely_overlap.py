"""Which scans overlap by the present poses, and how much.

Of few scans every pair is looked at; of many, pairs that share cells of space, drawn at
random. What has not moved since is not looked at again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.batching.padding import rounded_up
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.geometry import lie
from jaxreg.matching import Match, known, match
from jaxreg.multiview.choose_pairs import all_pairs, ascending, pair_keys
from jaxreg.multiview.in_blocks import in_blocks
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans


# Poses of a chain drift: points this many spacings apart, one spacing over or under the
# other's plane, may still be of one place.
_DRIFT = 6.0
# Points of a scan that tell what share of it another saw, to 0.02.
_POINTS = 512
# Pairs of a block: each is work of a fraction of a millisecond.
_BLOCK = 512
# Scans up to which every pair is looked at, and draws of each scan of more.
_ALL_UP_TO, _DRAWS = 128, 64
# Edge of a cell in radii: a scan, some three radii wide, has about a hundred.
_CELL = 0.5
# Of the numbers of cells (Teschner et al. 2003), and how many these are at most.
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791])
_PRIME, _MOST = 2_654_435_761, 1 << 40
# Poses that changed by less, in spacings at a radius, leave the overlap as it was.
_STILL = 1.0


class NearPairs(NamedTuple):
    """Pairs that may overlap.

    Attributes:
        pairs: `(c, 2)` scans i < j; those of a scan and itself are padding.
        overlap: `(c,)` the share of scan j that is near scan i.
    """

    pairs: Int[Array, "c 2"]
    overlap: Float[Array, " c"]

    def padded(self) -> "NearPairs":
        """To one of few sizes."""
        more = rounded_up(len(self.pairs)) - len(self.pairs)
        pairs = jnp.pad(self.pairs, ((0, more), (0, 0)))
        return NearPairs(pairs, jnp.pad(self.overlap, (0, more)))


class LikelyOverlap:
    """Remembers what it saw, from one round of poses to the next.

    Args:
        scans: prepared scans.
        held: `(v,)` scans whose pairs with each other are of no interest, or None.
    """

    def __init__(self, scans: PreparedScans, held: np.ndarray | None = None) -> None:
        self._scans = scans
        num = scans.num_present
        self._held = np.zeros(num, bool) if held is None else held[:num]
        self._keys = np.zeros(0, np.int64)
        D = scans.mean.shape[1] + 1
        self._T_i_j, self._overlap = np.zeros((0, D, D)), np.zeros(0)

    def of(self, placement: Placement, seed: int = 0) -> NearPairs:
        """Pairs by some poses, on the host; those seen before among them.

        Args:
            placement: the poses.
            seed: of the pairs that are drawn, where the scans are many.
        """
        scans, num = self._scans, self._scans.num_present
        T, part = np.asarray(placement.T_world_i), np.asarray(placement.part)[:num]
        if num <= _ALL_UP_TO:
            pairs = all_pairs(num)
        else:
            cells = np.asarray(_cells(scans, placement.T_world_i))[:num]
            rng = np.random.default_rng(seed)
            drawn = _sharing_cells(cells, part, np.flatnonzero(~self._held), rng)
            known = self._keys[self._overlap > 0]
            known = np.stack([known // num, known % num], axis=1)
            pairs = ascending(np.concatenate([known, drawn]))
        pairs = pairs[part[pairs[:, 0]] == part[pairs[:, 1]]]
        pairs = pairs[~self._held[pairs].all(axis=1)]
        keys = pair_keys(pairs, num)
        T_i_j = np.linalg.inv(T)[pairs[:, 0]] @ T[pairs[:, 1]]
        overlap = self._known(keys, T_i_j)
        new = np.isnan(overlap)
        seen = likely_overlap(scans, placement, jax.device_put(pairs[new]))
        overlap[new] = np.asarray(seen)
        self._keep(keys[new], T_i_j[new], overlap[new])
        overlap = overlap.astype(T.dtype)
        return NearPairs(*jax.device_put((pairs, overlap)))

    def _known(self, keys: np.ndarray, T_i_j: np.ndarray) -> np.ndarray:
        """What was seen of pairs that have not moved, NaN of the others."""
        out = np.full(len(keys), np.nan)
        if not len(self._keys):
            return out
        row = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        moved = np.abs(T_i_j - self._T_i_j[row]).sum(axis=(1, 2))
        least = _STILL * float(_coarsest(self._scans))
        still = (self._keys[row] == keys) & (moved <= least)
        out[still] = self._overlap[row[still]]
        return out

    def _keep(self, keys: np.ndarray, T: np.ndarray, overlap: np.ndarray) -> None:
        """In place of what was known of these pairs."""
        stays = ~np.isin(self._keys, keys)
        keys = np.concatenate([self._keys[stays], keys])
        order = np.argsort(keys)
        self._keys = keys[order]
        self._T_i_j = np.concatenate([self._T_i_j[stays], T])[order]
        self._overlap = np.concatenate([self._overlap[stays], overlap])[order]


@kept_program
def _coarsest(scans: PreparedScans) -> Scalar:
    return scans.coarsest


def likely_overlap(
    scans: PreparedScans, placement: Placement, pairs: Int[Array, "c 2"]
) -> Float[Array, " c"]:
    """The share of scan j that is near scan i by the poses; zero of padding."""

    def run(block: Array) -> Array:
        return _overlap(scans, placement, block)

    return in_blocks(run, pairs, (scans, placement), _BLOCK)


@kept_program
def _overlap(
    scans: PreparedScans, placement: Placement, pairs: Int[Array, "c 2"]
) -> Float[Array, " c"]:
    T = placement.T_world_i

    def share(pair: Array) -> Array:
        i, j = pair
        problem = scans.problem(i, j)
        problem = problem.every(-(-problem.source.shape[1] // _POINTS))
        return control.cond(
            placement.together(i, j) & (i != j),
            lambda: _near(match(problem, lie.between(T[i], T[j])), scans.coarsest),
            lambda: jnp.zeros_like(scans.coarsest),
        )

    return map_side_by_side(share, pairs, scans.num_rows)


def _near(found: Match, spacing: Scalar) -> Scalar:
    """The share of the points that may be of the other surface."""
    flat = known(found.normal)
    near = (found.sq_residual < (_DRIFT * spacing) ** 2) & found.mask
    near = near & (~flat | (jnp.abs(found.plane_residual) < spacing))
    share = jnp.sum(near) / jnp.maximum(jnp.sum(found.mask), 1)
    return share.astype(spacing.dtype)


@kept_program
def _cells(
    scans: PreparedScans, T_world_i: Float[Array, "v D D"]
) -> Int[Array, "v m d"]:
    """Where in the world some points of each scan lie; of the others the centre."""
    every = -(-scans.clouds.points.shape[1] // _POINTS)
    points, mask = scans.clouds.points[:, ::every], scans.clouds.mask[:, ::every]
    place = jax.vmap(lie.act)(T_world_i, jnp.where(mask[..., None], points, 0))
    return jnp.floor(place / _CELL).astype(jnp.int32)


def _sharing_cells(
    cells: np.ndarray, part: np.ndarray, scans: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Pairs of some scans with any, the likelier the more cells of space they share.

    Of each scan cells are drawn, and of each cell a scan that has points there.
    """
    num, m, _ = cells.shape
    # Cells of one number that are not the same cost a look, and do no harm.
    key = cells.astype(np.int64) @ _PRIMES[: cells.shape[-1]]
    key = key + part.astype(np.int64)[:, None] * _PRIME
    key, scan = key % _MOST, np.repeat(np.arange(num), m)
    theirs, key = np.unique(key[scans]), key.ravel()
    if len(scans) < num:
        place = np.minimum(np.searchsorted(theirs, key), len(theirs) - 1)
        of_theirs = theirs[place] == key
        key, scan = key[of_theirs], scan[of_theirs]
    key, scan = np.divmod(np.unique(key * num + scan), num)
    first = np.flatnonzero(np.diff(key, prepend=-1))
    cell, first = (
        np.cumsum(np.diff(key, prepend=-1) > 0) - 1,
        np.append(first, len(key)),
    )
    of_scan = np.argsort(scan, kind="stable")
    begin = np.searchsorted(scan[of_scan], np.arange(num + 1))
    begin, size = begin[scans, None], np.diff(begin)[scans, None]
    draw = rng.random((2, len(scans), _DRAWS))
    at = of_scan[begin + (draw[0] * size).astype(int)]
    low, high = first[cell[at]], first[cell[at] + 1]
    other = scan[low + (draw[1] * (high - low)).astype(int)]
    return np.column_stack([np.repeat(scans, _DRAWS), other.ravel()])
