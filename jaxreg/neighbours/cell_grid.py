"""Exact closest points within a radius: points in cells twice the radius wide.

Whatever lies within the radius of a query lies in the 2^d cells around the corner that
is nearest to it (Bentley and Friedman 1979, Data structures for range searching). Cells
that follow each other along the first axis hold points that do, so that a query is
compared with those of 2^(d-1) runs in memory.

Beyond the radius the answer is that of a voxel table or a nearer one: near, seldom the
closest. While a registration still takes large steps, the closest of every so-many-th
point answers: as near everywhere as points are dense there. (Cells as wide everywhere
are as wide as a room for what is close to a scanner, and led registration astray.)
"""

import functools
import itertools
import math
import operator
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.platforms import by_platform
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.geometry.spacing import median_spacing
from jaxreg.neighbours.base import AbstractIndex, closest_only, in_tiles, map_first
from jaxreg.neighbours.brute import BruteForce
from jaxreg.neighbours.extent import bulk_extent
from jaxreg.neighbours.sorting import rows_in_order
from jaxreg.neighbours.voxel_table import VoxelTable


_TILE = 512
_UNROLL = 2
# Of the table: small, as it is filled for every registration.
_RESOLUTION = {2: 64, 3: 16}
# Of about so many points the closest answers coarsely: 0.7 ms for 1,024 queries.
_COARSE = 2048
# Widths of cells that are tried.
_WIDTHS = 32
# Rows that are known to be those of points need no tests: a tenth of the time.
_WITHIN: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False}
# Cells are this much wider than two radii, for the rounding of coordinates.
_SLACK = 1.01


class CellGrid(AbstractIndex):
    """Exact within a radius; O(n + m) memory and at most 8 MB of cells.

    Some six million queries a second on one core of a CPU, of 1,000 to 100,000 targets,
    if the radius is their spacing: a query takes as long as the fullest of the cells
    around it. Ties go to any of the closest points.

    Attributes:
        radius: farther targets are called invalid by `query`, and `lookup` may find
            another one than the closest. As asked or wider.
        table: where the search for another begins.
    """

    points: Float[Array, "m d"]
    mask: Bool[Array, " m"]
    radius: Scalar
    table: VoxelTable
    rows: Int[Array, " m"]
    ordered: Float[Array, "d m"]
    start: Int[Array, " cells"]
    origin: Float[Array, " d"]
    size: Int[Array, " d"]

    @classmethod
    def build(
        cls,
        points: Points,
        mask: Mask | None = None,
        *,
        radius: Scalar | float | None = None,
    ) -> "CellGrid":
        """Sorts the points by cell and fills the table.

        Args:
            points: `(m, d)` target points.
            mask: `(m,)` True for valid points; those that are not finite are not.
            radius: within which the closest point is found, in the unit of the points;
                their spacing by default.
        """
        m, d = points.shape
        finite = jnp.all(jnp.isfinite(points), axis=1)
        mask = finite if mask is None else mask & finite
        frozen = jnp.where(mask[:, None], lax.stop_gradient(points), 0)
        if radius is None:
            radius = median_spacing(frozen, mask)
        radius = lax.stop_gradient(jnp.asarray(radius, points.dtype))
        cells = _resolution(m, d) ** d
        origin, width, size = _grid(frozen, mask, 2 * _SLACK * radius, cells)
        home = _cell_of(frozen.T, origin, width, size)
        home = jnp.where(mask, home, cells)
        rows = rows_in_order(home, cells.bit_length())
        count = jnp.zeros(cells, jnp.int32).at[home].add(1, mode="drop")
        start = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(count)])
        ordered = frozen[rows]
        table = VoxelTable.build(ordered, mask[rows], resolution=_RESOLUTION[d])
        radius = width / (2 * _SLACK)
        return cls(points, mask, radius, table, rows, ordered.T, start, origin, size)

    @property
    def reach(self) -> Scalar:
        """The radius."""
        return self.radius

    def lookup(
        self,
        columns: Float[Array, "d n"],
        num: Int[Array, ""] | None = None,
        coarse: Bool[Array, ""] | None = None,
    ) -> Int[Array, " n"]:
        """The closest valid target of each query, if it lies within the radius.

        Where `coarse` is True the closest of some of the targets.
        """
        columns = lax.stop_gradient(columns)
        if coarse is None:
            return self._exactly(columns, num)
        return control.cond(
            coarse,
            lambda columns: self._among_some(columns, num),
            lambda columns: self._exactly(columns, num),
            columns,
        )

    def lookup_nearest(self, columns: Float[Array, "d n"], k: int) -> Int[Array, "k n"]:
        """The closest only."""
        return closest_only(self, columns, k)

    def _among_some(
        self, columns: Float[Array, "d n"], num: Int[Array, ""] | None
    ) -> Int[Array, " n"]:
        # In the order of cells, so that they are spread evenly; valid points are first.
        every = max(1, -(-len(self.rows) // _COARSE))
        rows, points = self.rows[::every], self.ordered[:, ::every]
        some = BruteForce.build(points.T, self.mask[rows])
        return rows[some.lookup(columns, num)]

    def _exactly(
        self, columns: Float[Array, "d n"], num: Int[Array, ""] | None
    ) -> Int[Array, " n"]:
        axes = list(self.ordered)  # copies: here, not in the loop

        def by_tiles() -> Int[Array, " n"]:
            tiles = in_tiles(columns, _TILE)
            found = map_first(lambda tile: self._of_tile(tile, axes), tiles, num)
            return found.reshape(-1)[: columns.shape[1]]

        # An accelerator waits for each turn of a loop.
        row = by_platform(by_tiles, lambda: self._of_tile(columns, axes))
        return self.rows[row]

    def _of_tile(
        self, queries: Float[Array, "d t"], axes: list[Float[Array, " m"]]
    ) -> Int[Array, " t"]:
        """Rows among the ordered points."""
        d, width = self.points.shape[1], 2 * _SLACK * self.radius
        stride = jnp.cumprod(self.size)
        # The lower of the two cells along each axis.
        below = queries - width / 2
        corner = _cell_of(below, self.origin, width, self.size, beside=1)
        first, last = [], []
        for steps in itertools.product((0, 1), repeat=d - 1):
            offset = sum(s * stride[axis] for axis, s in enumerate(steps))
            first.append(self.start[corner + offset])
            last.append(self.start[corner + offset + 2] - 1)
        longest = jnp.max(jnp.stack(last) - jnp.stack(first))
        columns = jnp.unstack(queries)

        def sq_distance(row: Array) -> Array:
            closest = [x.at[row].get(**_WITHIN) for x in axes]
            terms = ((x - q) ** 2 for x, q in zip(closest, columns, strict=True))
            return functools.reduce(operator.add, terms)

        def look(state: tuple[Array, Array]) -> tuple[Array, Array]:
            at, row = state
            # Of two values that a loop carries XLA on CPU computes each by itself: the
            # distance of the best so far is cheaper to compute again than to carry.
            best = sq_distance(row)
            for offset in range(_UNROLL):
                for begin, end in zip(first, last, strict=True):
                    # Behind the end of its run: the end again, harmless.
                    other = jnp.maximum(jnp.minimum(begin + at + offset, end), 0)
                    sq = sq_distance(other)
                    row = jnp.where(sq < best, other, row)
                    best = jnp.minimum(sq, best)
            return at + _UNROLL, row

        start = (jnp.zeros((), jnp.int32), self.table.lookup(queries))
        return control.while_loop(lambda state: state[0] <= longest, look, start)[1]


def _resolution(num_points: int, d: int) -> int:
    """Cells along each axis of a cube, as wide as two spacings of a surface (a curve).

    As many cells in all serve boxes that are no cubes.
    """
    if d == 2:
        return min(max(num_points // 4, 16), 512)
    return min(max(8 * -(-math.isqrt(num_points) // 16), 8), 128)


def _grid(
    points: Array, mask: Array, width: Scalar, num_cells: int
) -> tuple[Float[Array, " d"], Scalar, Int[Array, " d"]]:
    """Lowest corner and width of the cells, no less than asked, and how many each way.

    As narrow as `num_cells` of them allow: those of a street are flat. Points beyond
    the bulk's extent are in the cells of the border.
    """
    m, d = points.shape
    low, high = bulk_extent(points, mask)
    extent = jnp.nan_to_num(high - low, posinf=0, neginf=0)
    widest = jnp.max(extent) / (_resolution(m, d) - 2)
    width = jnp.maximum(width, 1e-6 * widest)
    width = jnp.where(width > 0, width, 1)  # not for NaN either, where none is valid
    steps = jnp.linspace(0, 1, _WIDTHS, dtype=points.dtype)
    widths = width * jnp.maximum(widest / width, 1) ** steps
    sizes = jnp.floor(extent[None] / widths[:, None]) + 2
    fits = jnp.prod(sizes, axis=1) <= num_cells
    row = jnp.where(jnp.any(fits), jnp.argmax(fits), _WIDTHS - 1)
    width = widths[row]
    return jnp.nan_to_num(low - width / 4), width, sizes[row].astype(jnp.int32)


def _cell_of(
    columns: Float[Array, "d n"],
    origin: Array,
    width: Scalar,
    size: Int[Array, " d"],
    beside: int = 0,
) -> Int[Array, " n"]:
    """The cells of points, counted along the first axis first; the border's outside.

    With `beside` more cells on its other side.
    """
    flat, stride = jnp.zeros(columns.shape[1:], jnp.int32), 1
    for x, start, num in zip(*map(jnp.unstack, (columns, origin, size)), strict=True):
        at = jnp.clip((x - start) / width, 0, num - 1 - beside)
        flat, stride = flat + at.astype(jnp.int32) * stride, stride * num
    return flat
