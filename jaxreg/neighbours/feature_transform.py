"""The points closest to the centre of every cell of a grid, by separable sweeps.

Cells that hold points start with those nearest to their centre. Candidates then spread
by a forward and a backward sweep along each axis: a cell keeps the nearest of its own
candidates and those of the cell before it. This is the feature transform that distance
transforms are made of (Danielsson 1980), for lists of candidates; like it, it misses a
closer point in a few cells.

From coarse to fine: a grid of half the resolution is swept twice, and its candidates
start the fine one, which is then swept once. That takes two thirds of the time of two
sweeps of the fine grid (K = 1, 10,000 points in 64^3 cells: 10 for 15 ms on one core)
and answers as closely. More levels save no more.

Coordinates are in units of cells here, so that nothing depends on their scale.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control


# Grids of fewer cells along an axis are not halved.
_COARSEST = 16


def feature_transform(
    in_cells: Float[Array, "m d"],
    mask: Bool[Array, " m"],
    resolution: int,
    candidates: int,
) -> Int[Array, "k cells"]:
    """Rows of the points closest to each cell's centre, nearest first, -1 for surplus.

    Args:
        in_cells: points from the grid's origin, in units of cells.
        mask: True for valid points.
        resolution: cells along each axis.
        candidates: k.
    """
    if resolution % 2 or resolution <= _COARSEST:
        table = _closest_in_each_cell(in_cells, mask, resolution, candidates)
        table = _swept(table, in_cells, 2)
    else:
        half = resolution // 2
        coarse = _closest_in_each_cell(in_cells / 2, mask, half, candidates)
        coarse = _swept(coarse, in_cells / 2, 2)
        table = _closest_in_each_cell(in_cells, mask, resolution, candidates)
        table = _swept(_merge_cells(table, _doubled(coarse), in_cells), in_cells, 1)
    return table.reshape(candidates, -1)


def _doubled(table: Array) -> Array:
    """Each cell's candidates in the 2^d cells that it is divided into."""
    for axis in range(1, table.ndim):
        table = jnp.repeat(table, 2, axis=axis)
    return table


def _merge_cells(own: Array, other: Array, in_cells: Array) -> Array:
    """The nearest of two tables' candidates in every cell."""
    candidates, resolution, *_ = own.shape
    centres = jnp.arange(resolution, dtype=in_cells.dtype) + 0.5
    grid = jnp.meshgrid(*[centres] * (own.ndim - 1), indexing="ij")
    merge = _closer if candidates == 1 else _merge
    merged = merge(
        own.reshape(candidates, -1),
        other.reshape(candidates, -1),
        list(in_cells.T),
        [jnp.ravel(x) for x in grid],
    )
    return merged.reshape(own.shape)


def _closest_in_each_cell(
    in_cells: Array, mask: Array, resolution: int, candidates: int
) -> Array:
    """Of the points in a cell, those nearest to its centre."""
    d = in_cells.shape[1]
    cells = resolution**d
    at = jnp.clip(in_cells, 0, resolution - 1).astype(jnp.int32)
    home = jnp.zeros(len(at), jnp.int32)
    for axis in range(d):
        home = home * resolution + at[:, axis]
    to_centre = in_cells - at - 0.5  # of points beyond the grid farther than a cell
    sq = jnp.where(mask, jnp.sum(to_centre**2, axis=-1), jnp.inf)
    rows = jnp.arange(len(in_cells), dtype=jnp.int32)

    def take(sq: Array, _: None) -> tuple[Array, Array]:
        nearest = jax.ops.segment_min(sq, home, cells)
        winner = (sq < jnp.inf) & (sq <= nearest[home])
        row = jax.ops.segment_max(jnp.where(winner, rows, -1), home, cells)
        return jnp.where(row[home] == rows, jnp.inf, sq), jnp.maximum(row, -1)

    found = control.scan(take, sq, None, candidates)[1]
    return found.reshape(candidates, *(resolution,) * d)


def _swept(table: Array, in_cells: Array, times: int) -> Array:
    """So many times along each axis in turn, forward then backward.

    Always along the first axis of the grid, after which its axes move on by one, and
    backward is forward over lines in reverse: a sweep is compiled once.
    """
    candidates, resolution, *_ = table.shape
    d = table.ndim - 1
    centres = jnp.arange(resolution, dtype=in_cells.dtype) + 0.5
    others = [jnp.ravel(x) for x in jnp.meshgrid(*[centres] * (d - 1), indexing="ij")]
    merge = _closer if candidates == 1 else _merge
    lines = jnp.moveaxis(table, 0, 1).reshape(resolution, candidates, -1)

    def along_first(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        lines, columns = state
        axes = list(columns)

        def step(before: Array, line: tuple[Array, Array]) -> tuple[Array, Array]:
            coordinate, own = line
            best = merge(own, before, axes, [coordinate, *others])
            return best, best

        def sweep(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            lines, coordinates = state
            start = jnp.full(lines.shape[1:], -1, lines.dtype)
            lines = control.scan(step, start, (coordinates, lines))[1]
            return lines[::-1], coordinates[::-1]

        lines = control.fori_loop(0, 2, sweep, (lines, centres))[0]
        grid = lines.reshape(resolution, candidates, resolution, -1)
        grid = jnp.moveaxis(grid, 0, -1)  # (k, second, .., first)
        lines = jnp.moveaxis(grid, 0, 1).reshape(lines.shape)
        return lines, jnp.roll(columns, -1, axis=0)

    lines = control.fori_loop(0, d * times, along_first, (lines, in_cells.T))[0]
    return jnp.moveaxis(lines, 1, 0).reshape(table.shape)


def _sq_distance(row: Array, axes: list[Array], centre: list[Array]) -> Array:
    sq = (axes[0][row] - centre[0]) ** 2
    for x, c in zip(axes[1:], centre[1:], strict=True):
        sq = sq + (x[row] - c) ** 2
    return jnp.where(row >= 0, sq, jnp.inf)


def _closer(own: Array, before: Array, axes: list[Array], centre: list[Array]) -> Array:
    """The closer of one candidate each."""
    mine, theirs = (_sq_distance(row[0], axes, centre) for row in (own, before))
    return jnp.where((mine <= theirs)[None], own, before)


def _merge(own: Array, before: Array, axes: list[Array], centre: list[Array]) -> Array:
    """The nearest of two lists of different candidates, without repetition."""
    k = len(own)

    def new(row: Array) -> Array:
        repeated = row == own[0]
        for i in range(1, k):
            repeated = repeated | (row == own[i])
        return jnp.where(repeated, -1, row)

    rows = jnp.concatenate([own, lax.map(new, before)])
    sq = lax.map(lambda row: _sq_distance(row, axes, centre), rows)
    return smallest(sq, rows, k)


def smallest(sq: Float[Array, "s n"], rows: Int[Array, "s n"], k: int) -> Array:
    """The `(k, n)` rows of the k smallest of s values, ascending; ties in order.

    Counts for each value how many precede it: on CPU many times faster than a sort,
    because it has no branch and runs along n.
    """
    s = len(sq)

    def count(own: tuple[Array, Array]) -> Array:
        number, value = own
        rank = jnp.zeros(value.shape, jnp.int32)
        for i in range(s):
            first = jnp.where(i < number, sq[i] <= value, sq[i] < value)
            rank = rank + first.astype(jnp.int32)
        return rank

    rank = lax.map(count, (jnp.arange(s, dtype=jnp.int32), sq))

    def take(position: Array) -> Array:
        row = rows[0]
        for i in range(1, s):
            row = jnp.where(rank[i] == position, rows[i], row)
        return row

    return lax.map(take, jnp.arange(k, dtype=jnp.int32))
