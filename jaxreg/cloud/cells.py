"""Cubic cells around points, numbered along a Morton curve.

The number of the cell of twice the size is the number without its last d bits: one
sort gives the cells of all sizes.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.neighbours.sorting import rows_in_order


UNUSED = jnp.iinfo(jnp.int32).max


def bits_per_axis(d: int) -> int:
    """1,024 cells along each axis in 3D, 32,768 in 2D."""
    return 30 // d


def morton_keys(cells: Int[Array, " d *c"]) -> Int[Array, " *c"]:
    """Interleaves the bits of cell coordinates below 2^bits_per_axis."""
    d = cells.shape[0]
    key = jnp.zeros_like(cells[0])
    for axis in range(d):
        x = cells[axis]
        # The classic spread by halves: 3 -> 2 zeros between bits, 2 -> 1 zero.
        steps = (
            ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))
            if d == 3
            else ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555))
        )
        for shift, keep in steps:
            x = (x | (x << shift)) & keep
        key = key | (x << (d - 1 - axis))
    return key


def cell_keys(
    points: Points, mask: Mask, low: Float[Array, " d"], size: Scalar
) -> Int[Array, " n"]:
    """Morton numbers of the cells of `(n, d)` points; `UNUSED` where masked."""
    last = (1 << bits_per_axis(points.shape[1])) - 1
    cells = jnp.clip((points - low[None]) / size, 0, last).astype(jnp.int32)
    return jnp.where(mask, morton_keys(cells.T), UNUSED)


def _num_filled(
    ordered: Int[Array, " n"], shift: Int[Array, ""] | int = 0
) -> Int[Array, ""]:
    key = ordered >> shift
    new = (key[1:] != key[:-1]) & (ordered[1:] != UNUSED)
    return jnp.sum(new) + (ordered[0] != UNUSED)


def cell_size(
    points: Points,
    mask: Mask,
    low: Float[Array, " d"],
    side: Scalar,
    num: float | Float[Array, ""],
) -> Float[Array, ""]:
    """A size at which nearly `num` cells are filled.

    Counted at all powers of two from one sort, and interpolated between them.
    """
    d = points.shape[1]
    bits = bits_per_axis(d)
    finest = side / ((1 << bits) - 1)
    ordered = jnp.sort(cell_keys(points, mask, low, finest))
    shifts = d * jnp.arange(bits + 1, dtype=jnp.int32)
    counts = lax.map(lambda shift: _num_filled(ordered, shift), shifts)
    level = jnp.argmax(counts <= num)  # counts fall; the last is 1
    few = jnp.maximum(counts[level], 1).astype(side.dtype)
    many = jnp.maximum(counts[jnp.maximum(level - 1, 0)], 1).astype(side.dtype)
    share = jnp.log(jnp.clip(num, few, many) / few)
    share = share / jnp.log(jnp.maximum(many / few, 2.0))
    return finest * 2.0 ** (level - share)


def cells_in_order(
    points: Points, mask: Mask, low: Float[Array, " d"], size: Scalar
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Rows that sort the points by the keys of their cells, and those keys."""
    keys = cell_keys(points, mask, low, size)
    rows = rows_in_order(keys, 31)
    return rows, keys[rows]


def at_most(
    cap: int,
    points: Points,
    mask: Mask,
    low: Float[Array, " d"],
    side: Scalar,
    size: Scalar,
) -> tuple[Float[Array, ""], Int[Array, " n"], Int[Array, " n"]]:
    """The first size from `size` up at which at most `cap` cells are filled.

    And the points' order and keys. Of more than `cap` rows: the first order is not
    one, but a key each.
    """

    def too_many(state: tuple[Array, Array, Array]) -> Array:
        size, _, keys = state
        return (_num_filled(keys) > cap) & (size < side)

    def coarser(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        size = 1.05 * state[0]
        return size, *cells_in_order(points, mask, low, size)

    # Starts below and not in order, so that the order is computed in one place.
    start = jnp.arange(points.shape[0], dtype=jnp.int32)
    return control.while_loop(too_many, coarser, (size / 1.05, start, start))
