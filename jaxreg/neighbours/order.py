"""Points along a Hilbert curve: neighbours in space become neighbours in memory."""

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxreg._core.typing import Mask, Points
from jaxreg.geometry.boxes import bounding_cube
from jaxreg.neighbours.sorting import rows_in_order


def hilbert_order(points: Points, mask: Mask) -> Int[Array, " n"]:
    """Rows of `(n, d)` points in the order of a Hilbert curve through their cells.

    Points of one cell keep their order. Masked points take the last cell's place.
    """
    bits = _bits_per_axis(*points.shape)
    key = _hilbert_keys(points, mask, bits)
    return rows_in_order(key, bits * points.shape[1])


def _bits_per_axis(n: int, d: int) -> int:
    """Cells four times finer than n samples of a surface (a filled square in 2D)."""
    return min((n - 1).bit_length() // 2 + 2, 30 // d)


def _hilbert_keys(points: Array, mask: Array, bits: int) -> Int[Array, " n"]:
    """Skilling 2004, Programming the Hilbert curve: axes to the transposed index."""
    d = points.shape[1]
    low, side = bounding_cube(points, mask)
    cells = (points - low[None]) / side * (1 << bits)
    cells = jnp.clip(cells, 0, (1 << bits) - 1).astype(jnp.int32)
    x = [cells[:, axis] for axis in range(d)]
    for level in range(bits - 1, 0, -1):
        q, low_bits = 1 << level, (1 << level) - 1
        for axis in range(d):
            upper = (x[axis] & q) != 0
            swap = (x[0] ^ x[axis]) & low_bits
            first = jnp.where(upper, x[0] ^ low_bits, x[0] ^ swap)
            if axis:
                x[axis] = jnp.where(upper, x[axis], x[axis] ^ swap)
            else:
                first = jnp.where(upper, first, x[0])
            x[0] = first
    for axis in range(1, d):
        x[axis] = x[axis] ^ x[axis - 1]
    gray = jnp.zeros_like(x[0])
    for level in range(bits - 1, 0, -1):
        gray = jnp.where(
            (x[d - 1] & (1 << level)) != 0, gray ^ ((1 << level) - 1), gray
        )
    key = jnp.zeros_like(x[0])
    for level in range(bits - 1, -1, -1):
        for axis in range(d):
            key = (key << 1) | (((x[axis] ^ gray) >> level) & 1)
    return jnp.where(mask, key, (1 << (bits * d)) - 1)
