"""Exact closest points by comparing every pair, tile by tile.

The oracle of all other indexes, and the fastest exact search for a few thousand
targets. Targets are compared in groups of 16: the least squared distance of a group to
every query of a tile is one branch-free expression, which XLA on CPU turns into vector
code of about 10 billion pairs a second. Only the best group of each query is kept; the
row within it is found by comparing its 16 points once more.

The k closest points lie in the k groups of the least distances, so for k > 1 as well
only those groups' points are ranked.

Two properties of XLA on CPU shape the code. The minimum of floats must pass NaN on,
which costs two more instructions than that of integers, whose order is the same for
numbers that are not negative. And a value with two users is computed for each of them,
unless a loop returns it: hence the loop over groups whose only result is stored, and no
long chain in which each comparison uses the last one twice.
"""

import functools
import operator
from collections.abc import Callable, Iterable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.platforms import by_platform
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.neighbours import all_pairs
from jaxreg.neighbours.base import AbstractIndex, closest_only, map_first


_GROUP = 16
_GROUPS = 64  # in a tile of targets: its least distances stay in the cache
_QUERIES = 1024
_QUERIES_RANKED = 128  # in a tile of queries for k > 1
_UNROLL = 4
# The largest coordinate is scaled to about one if it is within these.
_SIZES = 2.0**-100, 2.0**100
# Of so many at most each is found in turn, without a branch: of ten in a third of the
# time of `lax.top_k` on a CPU.
_FEW = 16


class BruteForce(AbstractIndex):
    """Exact search over all targets; O(n + m) memory, O(n m) time.

    Ties go to the lowest row, of distances rounded to the dtype. Targets that are not
    finite are never found. All targets are tied for a query 1e18 times as far away as
    the largest coordinate of a target, and so are targets whose distances are that
    much smaller than it.
    """

    points: Float[Array, "m d"]
    mask: Bool[Array, " m"]

    @classmethod
    def build(cls, points: Points, mask: Mask | None = None) -> "BruteForce":
        """Stores the points; there is nothing to prepare."""
        finite = jnp.all(jnp.isfinite(points), axis=1)
        return cls(points, finite if mask is None else mask & finite)

    @property
    def reach(self) -> Scalar:
        """Anywhere."""
        return jnp.asarray(jnp.inf, self.points.dtype)

    def lookup(
        self,
        columns: Float[Array, "d n"],
        num: Int[Array, ""] | None = None,
        coarse: Bool[Array, ""] | None = None,
    ) -> Int[Array, " n"]:
        """The closest valid target of each query, exactly."""
        points, scale = self._scaled()
        columns = scale * lax.stop_gradient(columns)
        row = by_platform(
            lambda: _closest(columns, points, num),
            lambda: all_pairs.closest(columns, points.T),
        )
        # Where all are too far.
        first = jnp.argmax(self.mask).astype(jnp.int32)
        return jnp.where((row < 0) | ~self.mask[row], first, row)

    def lookup_nearest(self, columns: Float[Array, "d n"], k: int) -> Int[Array, "k n"]:
        """The k closest valid targets of each query, exactly; -1 for surplus."""
        if k == 1:
            return closest_only(self, columns, k)
        points, scale = self._scaled()
        columns = scale * lax.stop_gradient(columns)
        return by_platform(
            lambda: _nearest(columns, points, k),
            lambda: all_pairs.nearest(columns, points.T, k),
        )

    def _scaled(self) -> tuple[Float[Array, "m d"], Float[Array, ""]]:
        """Scaled targets, inf where there is none, and the scale.

        The scale is a power of two, so that nothing is rounded, and keeps squared
        distances in the range of the dtype.
        """
        points = lax.stop_gradient(self.points)
        largest = jnp.max(jnp.where(self.mask[:, None], jnp.abs(points), 0))
        bits = jnp.finfo(points.dtype).nexp
        near = lax.reduce_precision(jnp.clip(largest, *_SIZES), bits, mantissa_bits=0)
        scale = 1 / near
        return jnp.where(self.mask[:, None], points * scale, jnp.inf), scale


def _closest(
    columns: Float[Array, "d n"],
    points: Float[Array, "m d"],
    num: Int[Array, ""] | None,
) -> Int[Array, " n"]:
    """The first closest point of each query; -1 if none is finite."""
    groups = _in_groups(points)
    # Less padding than rounding the number of groups up to a whole tile.
    tiles = -(-len(groups) // _GROUPS)
    length = -(-len(groups) // (tiles * _UNROLL)) * _UNROLL
    pad = tiles * length - len(groups)
    groups = jnp.pad(groups, ((0, pad), (0, 0), (0, 0)), constant_values=jnp.inf)

    def of_tile(queries: Array) -> Array:
        group = _closest_group(queries, groups.reshape(tiles, length, -1, _GROUP))
        return _closest_in_group(queries, groups, group)

    return _by_tiles(of_tile, columns, _QUERIES, num)


def _nearest(
    columns: Float[Array, "d n"], points: Float[Array, "m d"], k: int
) -> Int[Array, "k n"]:
    """The k closest points of each query, ascending; -1 for surplus."""
    groups = _in_groups(points)

    def of_tile(queries: Array) -> Array:
        least = lax.map(lambda g: _least_distance(queries, g), groups)
        return _rank(queries, groups, least, k)

    return _by_tiles(of_tile, columns, _QUERIES_RANKED)


def _in_groups(points: Float[Array, "m d"]) -> Float[Array, "g d w"]:
    m, d = points.shape
    padded = jnp.pad(points, ((0, -m % _GROUP), (0, 0)), constant_values=jnp.inf)
    return jnp.swapaxes(padded.reshape(-1, _GROUP, d), 1, 2)


def _by_tiles(
    find: Callable[[Array], Array], columns: Array, size: int, num: Array | None = None
) -> Array:
    """`find` of tiles `(d, t)` of the queries, side by side along the last axis."""
    d, n = columns.shape
    tiles = max(-(-n // size), 1)
    size = -(-n // tiles)
    padded = jnp.pad(columns, ((0, 0), (0, tiles * size - n)))
    found = map_first(find, jnp.swapaxes(padded.reshape(d, tiles, size), 0, 1), num)
    found = jnp.moveaxis(found, 0, -2)
    return found.reshape(*found.shape[:-2], -1)[..., :n]


def _least_distance(
    queries: Float[Array, "d t"], group: Float[Array, "d w"]
) -> Float[Array, " t"]:
    """Squared distance of each query to the closest point of a group."""
    rows = jnp.unstack(queries)
    points = zip(*(jnp.unstack(row) for row in jnp.unstack(group)), strict=True)
    each = (_ordered(_sum_of_squares(rows, point)) for point in points)
    least = functools.reduce(jnp.minimum, each)
    return lax.bitcast_convert_type(least, queries.dtype)


def _closest_group(
    queries: Float[Array, "d t"], tiles: Float[Array, "a b d w"]
) -> Int[Array, " t"]:
    """The first group with the least distance; -1 if none is finite."""

    def visit(state: tuple[Array, Array], tile: tuple[Array, Array]):
        first, groups = tile
        least = lax.map(lambda group: _least_distance(queries, group), groups)

        def pick(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            best, number = state
            for i in range(_UNROLL):
                at = step * _UNROLL + i
                sq = least[at]
                closer = sq < best
                number = jnp.where(closer, first + at, number)
                best = jnp.where(closer, sq, best)
            return best, number

        return control.fori_loop(0, least.shape[0] // _UNROLL, pick, state), None

    n = queries.shape[1]
    start = jnp.full(n, jnp.inf, queries.dtype), jnp.full(n, -1, jnp.int32)
    first = jnp.arange(tiles.shape[0], dtype=jnp.int32) * tiles.shape[1]
    return control.scan(visit, start, (first, tiles))[0][1]


def _closest_in_group(
    queries: Float[Array, "d t"], groups: Float[Array, "g d w"], group: Int[Array, " t"]
) -> Int[Array, " t"]:
    """The row of the first closest point in each query's own group; -1 without one."""
    points = jnp.moveaxis(groups[group], 0, -1)
    sq = _ordered(_sq_distance(queries[:, None], points))
    number = jnp.arange(_GROUP, dtype=jnp.int32)[:, None]
    least = jnp.min(sq, axis=0, keepdims=True)
    closest = jnp.min(jnp.where(sq == least, number, _GROUP), axis=0)
    return jnp.where(group < 0, -1, group * _GROUP + closest)


def _rank(
    queries: Float[Array, "d t"],
    groups: Float[Array, "g d w"],
    least: Float[Array, "g t"],
    k: int,
) -> Int[Array, "k t"]:
    """The rows of the k closest points, given every group's least distance."""
    number = _least_rows(least, min(k, least.shape[0]))
    number = jnp.sort(number, axis=0)  # ties go to the lowest row
    points = jnp.moveaxis(groups[number], (0, 1, 2, 3), (1, 3, 0, 2))
    sq = _sq_distance(queries[:, None, None], points).reshape(-1, queries.shape[1])
    within = jnp.arange(_GROUP, dtype=jnp.int32)[None, :, None]
    row = number[:, None] * _GROUP + within
    at = _least_rows(sq, min(k, len(sq)))
    found = jnp.take_along_axis(row.reshape(sq.shape), at, axis=0)
    found = jnp.where(jnp.take_along_axis(sq, at, axis=0) < jnp.inf, found, -1)
    return jnp.pad(found, ((0, k - len(at)), (0, 0)), constant_values=-1)


def _least_rows(sq: Float[Array, "n t"], k: int) -> Int[Array, "k t"]:
    """The rows of the k least values of each column, ascending; ties to the lowest."""
    if k > _FEW:
        return lax.top_k(-sq.T, k)[1].T
    number = jnp.arange(len(sq), dtype=jnp.int32)[:, None]
    none = jnp.iinfo(jnp.int32 if sq.dtype.itemsize == 4 else jnp.int64).max

    def next_one(left: Array, _: None) -> tuple[Array, Array]:
        least = jnp.min(left, axis=0)
        row = jnp.min(jnp.where(left == least[None], number, len(sq)), axis=0)
        return jnp.where(number == row[None], none, left), row

    return control.scan(next_one, _ordered(sq), None, length=k)[1]


def _ordered(sq: Array) -> Array:
    """Integers in the order of numbers that are not negative."""
    bits = jnp.int32 if sq.dtype.itemsize == 4 else jnp.int64
    return lax.bitcast_convert_type(sq, bits)


def _sq_distance(a: Array, b: Array) -> Array:
    """Sum over the first axis, unrolled: XLA vectorises over the rest."""
    return _sum_of_squares(jnp.unstack(a), jnp.unstack(b))


def _sum_of_squares(a: Iterable[Array], b: Iterable[Array]) -> Array:
    gaps = (x - y for x, y in zip(a, b, strict=True))
    return functools.reduce(operator.add, (gap * gap for gap in gaps))
