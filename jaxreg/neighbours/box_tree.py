"""Exact closest points at scale: two levels of boxes over points in Hilbert order.

Consecutive points of the curve form leaves of 32, and 16 leaves a node; both know
their bounding boxes. Queries are answered in tiles of 128, which are compact if the
queries follow a curve as well: a tile visits the nodes, and in a node the leaves,
nearest box first, as long as a box is closer than the worst of the tile's answers
(branch and bound, Fukunaga and Narendra 1975, for a tile at once). A visit compares
all pairs of the tile and the leaf without a branch, which XLA vectorises.

Two properties of XLA on CPU shape the code: an integer `min` is vectorised and a float
`min` to a scalar is not, so distances are reduced as the integers of the same bits,
which order alike; and a value with two users is computed twice unless a loop of two
or more trips returns it.

An accelerator compares all pairs instead.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.platforms import by_platform
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.neighbours.base import AbstractIndex, closest_only, in_tiles, map_first
from jaxreg.neighbours.brute import BruteForce
from jaxreg.neighbours.order import hilbert_order


_LEAF = 32
_NODE = 16
_TILE = 128
_UNROLL = 8

# Ascending squared distances, and the leaves or rows that they belong to.
_Found = tuple[Array, Array]


class BoxTree(AbstractIndex):
    """Exact search from some thousand to a million targets; O(n + m) memory.

    Queries may come in any order: `lookup_nearest` sorts them along the curve, as does
    `query`; `lookup` is fast where neighbours in memory are neighbours in space
    (`hilbert_order`), and slower than brute force in random order. Ties go to any of
    the closest points.
    """

    points: Float[Array, "m d"]
    mask: Bool[Array, " m"]
    leaf_points: Float[Array, "l d w"]
    leaf_rows: Int[Array, "l w"]
    leaf_low: Float[Array, "s d u"]
    leaf_high: Float[Array, "s d u"]
    node_low: Float[Array, "d s"]
    node_high: Float[Array, "d s"]

    @classmethod
    def build(cls, points: Points, mask: Mask | None = None) -> "BoxTree":
        """Sorts the points along the curve and bounds them."""
        m, d = points.shape
        finite = jnp.all(jnp.isfinite(points), axis=1)
        mask = finite if mask is None else mask & finite
        frozen = lax.stop_gradient(points)
        rows = hilbert_order(frozen, mask)
        inf = jnp.asarray(jnp.inf, points.dtype)
        ordered = jnp.where(mask[rows, None], frozen[rows], inf)
        pad = -m % (_LEAF * _NODE)
        ordered = jnp.pad(ordered, ((0, pad), (0, 0)), constant_values=inf)
        leaves = ordered.reshape(-1, _LEAF, d)
        low = jnp.min(leaves, axis=1)
        high = jnp.max(jnp.where(leaves < inf, leaves, -inf), axis=1)
        low, high = low.reshape(-1, _NODE, d), high.reshape(-1, _NODE, d)
        return cls(
            points,
            mask,
            jnp.swapaxes(leaves, 1, 2),
            jnp.pad(rows, (0, pad)).reshape(-1, _LEAF),
            jnp.swapaxes(low, 1, 2),
            jnp.swapaxes(high, 1, 2),
            jnp.min(low, axis=1).T,
            jnp.max(high, axis=1).T,
        )

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
        """A closest valid target of each query."""
        return by_platform(
            lambda: self._lookup(columns, num),
            lambda: BruteForce(self.points, self.mask).lookup(columns, num),
        )

    def lookup_nearest(self, columns: Float[Array, "d n"], k: int) -> Int[Array, "k n"]:
        """The k closest valid targets of each query; -1 for surplus."""
        return by_platform(
            lambda: self._lookup_nearest(columns, k),
            lambda: BruteForce(self.points, self.mask).lookup_nearest(columns, k),
        )

    def _lookup(
        self, columns: Float[Array, "d n"], num: Int[Array, ""] | None
    ) -> Int[Array, " n"]:
        n = columns.shape[1]
        tiles = self._tiles(columns)
        leaf = map_first(self._leaf_of_tile, tiles, num).reshape(-1)[:n]
        return self._row_in_leaf(lax.stop_gradient(columns), leaf)

    def _lookup_nearest(
        self, columns: Float[Array, "d n"], k: int
    ) -> Int[Array, "k n"]:
        n = columns.shape[1]
        columns = lax.stop_gradient(columns)
        order = hilbert_order(jnp.nan_to_num(columns.T), jnp.ones(n, bool))
        columns = columns[:, order]
        if k == 1:
            rows = closest_only(self, columns, k)
        else:
            tiles = self._tiles(columns)
            rows = lax.map(lambda queries: self._rows_of_tile(queries, k), tiles)
            rows = jnp.moveaxis(rows, 0, 1).reshape(k, -1)[:, :n]
        return jnp.zeros_like(rows).at[:, order].set(rows)

    def _tiles(self, columns: Float[Array, "d n"]) -> Float[Array, "a d t"]:
        columns = lax.stop_gradient(columns)
        # A query that is not finite would spoil the bounds of its tile.
        finite = jnp.all(jnp.isfinite(columns), axis=0)
        columns = jnp.where(finite, columns, self.leaf_points[0, :, :1])
        return in_tiles(columns, _TILE)

    def _leaf_of_tile(self, queries: Float[Array, "d t"]) -> Int[Array, " t"]:
        """The leaf that holds the closest point of each query."""

        def look(number: Array, found: _Found) -> _Found:
            best, leaf = found
            sq = _closest_in_leaf(queries, self.leaf_points, number)
            return jnp.where(sq < best, sq, best), jnp.where(sq < best, number, leaf)

        # The leaf at the tile's centre comes first: the boxes of many may touch the
        # tile itself.
        low, high = jnp.min(queries, axis=1), jnp.max(queries, axis=1)
        leaf = jnp.full(queries.shape[1], self._leaf_at((low + high) / 2), jnp.int32)
        best = _closest_in_leaf(queries, self.leaf_points, leaf[0])
        return self._visit(queries, look, (best, leaf))[1]

    def _rows_of_tile(self, queries: Float[Array, "d t"], k: int) -> Int[Array, "k t"]:
        """The rows of the k closest points of each query, nearest first."""

        def look(number: Array, found: _Found) -> _Found:
            points, rows = self.leaf_points[number], self.leaf_rows[number]

            def insert(at: Array, found: _Found) -> _Found:
                sq, row = found
                new = _sq_distance(queries, points[:, at])[None]
                # Ascending lists: what is farther than the new one moves down.
                above = jnp.pad(sq[:-1], ((1, 0), (0, 0)), constant_values=-jnp.inf)
                row_above = jnp.pad(row[:-1], ((1, 0), (0, 0)))
                stays, moves = sq <= new, above > new
                row = jnp.where(stays, row, jnp.where(moves, row_above, rows[at]))
                return jnp.where(stays, sq, jnp.where(moves, above, new)), row

            return control.fori_loop(0, _LEAF, insert, found)

        shape = (k, queries.shape[1])
        nothing = (
            jnp.full(shape, jnp.inf, queries.dtype),
            jnp.full(shape, -1, jnp.int32),
        )
        return self._visit(queries, look, nothing)[1]

    def _visit(
        self,
        queries: Float[Array, "d t"],
        look: Callable[[Array, _Found], _Found],
        found: _Found,
    ) -> _Found:
        """Looks at every leaf that may improve the tile's worst answer."""
        low, high = jnp.min(queries, axis=1), jnp.max(queries, axis=1)
        to_nodes = _box_distance(self.node_low, self.node_high, low, high)
        used = _bits(jnp.asarray(jnp.inf, queries.dtype))

        def visit_node(state: tuple) -> tuple:
            _, node, to_nodes, found = state
            to_leaves = _box_distance(
                self.leaf_low[node], self.leaf_high[node], low, high
            )

            def visit_leaf(state: tuple) -> tuple:
                _, at, to_leaves, found = state
                found = look(node * _NODE + at, found)
                to_leaves = jnp.where(jnp.arange(_NODE) == at, used, to_leaves)
                return *_next(to_leaves, found[0]), to_leaves, found

            start = *_next(to_leaves, found[0]), to_leaves, found
            found = control.while_loop(lambda s: s[0], visit_leaf, start)[-1]
            to_nodes = lax.dynamic_update_index_in_dim(to_nodes, used, node, 0)
            return *_next(to_nodes, found[0]), to_nodes, found

        start = *_next(to_nodes, found[0]), to_nodes, found
        return control.while_loop(lambda s: s[0], visit_node, start)[-1]

    def _leaf_at(self, point: Float[Array, " d"]) -> Int[Array, ""]:
        """The leaf whose box is closest, in the node whose box is closest."""
        node = _first_least(_box_distance(self.node_low, self.node_high, point, point))
        low, high = self.leaf_low[node], self.leaf_high[node]
        return node * _NODE + _first_least(_box_distance(low, high, point, point))

    def _row_in_leaf(
        self, columns: Float[Array, "d n"], leaf: Int[Array, " n"]
    ) -> Int[Array, " n"]:
        d = columns.shape[0]
        flat = self.leaf_points.reshape(-1, d * _LEAF)

        def part(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            best, lane = state
            for at in range(_UNROLL):
                at = step * _UNROLL + at
                point = [flat[leaf, axis * _LEAF + at] for axis in range(d)]
                sq = _sq_distance(columns, point)
                lane = jnp.where(sq < best, at, lane)
                best = jnp.minimum(best, sq)
            return best, lane

        start = (
            jnp.full(leaf.shape, jnp.inf, columns.dtype),
            jnp.zeros(leaf.shape, jnp.int32),
        )
        lane = control.fori_loop(0, _LEAF // _UNROLL, part, start)[1]
        return self.leaf_rows[leaf, lane]


def _bits(x: Array) -> Array:
    """The integers of the bits: they order non-negative floats."""
    return lax.bitcast_convert_type(
        x, jnp.int32 if x.dtype == jnp.float32 else jnp.int64
    )


def _box_distance(low: Array, high: Array, from_low: Array, from_high: Array) -> Array:
    """Bits of the squared distances from one box to boxes given as `(d, s)`."""
    sq = jnp.zeros(low.shape[1:], low.dtype)
    for axis in range(low.shape[0]):
        gap = jnp.maximum(low[axis] - from_high[axis], from_low[axis] - high[axis])
        sq = sq + jnp.maximum(gap, 0) ** 2
    return _bits(sq)


def _first_least(x: Int[Array, " s"]) -> Int[Array, ""]:
    number = jnp.arange(x.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(x == jnp.min(x), number, number[-1]))


def _next(to_boxes: Array, best: Array) -> tuple[Array, Array]:
    """Whether the closest box may improve the tile's worst answer, and its number.

    Of `(k, t)` answers the last are the worst.
    """
    worst = jnp.max(_bits(best if best.ndim == 1 else best[-1]))
    return jnp.min(to_boxes) < worst, _first_least(to_boxes)


def _closest_in_leaf(queries: Array, leaf_points: Array, number: Array) -> Array:
    """Squared distance of each query to the closest point of a leaf."""
    d = queries.shape[0]

    def part(step: Array, best: Array) -> Array:
        at = (number, jnp.zeros_like(number), (step * _UNROLL).astype(number.dtype))
        points = lax.dynamic_slice(leaf_points, at, (1, d, _UNROLL))[0]
        for lane in range(_UNROLL):
            best = jnp.minimum(best, _sq_distance(queries, points[:, lane]))
        return best

    start = jnp.full(queries.shape[1], jnp.inf, queries.dtype)
    return control.fori_loop(0, _LEAF // _UNROLL, part, start)


def _sq_distance(a: Array, b: Array | list[Array]) -> Array:
    """Sum over the d rows, unrolled: XLA vectorises over the points."""
    sq = (a[0] - b[0]) ** 2
    for axis in range(1, a.shape[0]):
        sq = sq + (a[axis] - b[axis]) ** 2
    return sq
