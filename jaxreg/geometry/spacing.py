"""How densely a cloud is sampled."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import spread_rows
from jaxreg._core.typing import Mask, Points


_SAMPLES = 64


def median_spacing(points: Points, mask: Mask) -> Float[Array, ""]:
    """The spacing of the samples: on a regular grid its step.

    The median distance from a valid point to its second other point on a curve, its
    fourth on a surface: the nearest one tells little of random samples. Measured from
    64 valid rows spread over the array; duplicates of a point are skipped.

    Gradients: of that distance; which points it is between is held.
    """
    columns = lax.stop_gradient(points.T)
    at, use = spread_rows(mask, _SAMPLES)
    other = lax.map(lambda row: _other(columns[:, row], columns, mask), at)
    sq = jnp.sum((points[at] - points[other]) ** 2, axis=1)
    use = use & (other >= 0) & (sq > 0)
    distance = jnp.sqrt(jnp.where(use, sq, 1))
    spacing = jnp.nanmedian(jnp.where(use, distance, jnp.nan))
    return jnp.where(jnp.any(use), spacing, 0)


def _other(
    query: Float[Array, " d"], columns: Float[Array, "d n"], mask: Mask
) -> Int[Array, ""]:
    """The second (2D) or fourth (3D) nearest other point, or the last; -1 if none."""
    d, n = columns.shape
    sq = (columns[0] - query[0]) ** 2
    for axis in range(1, d):
        sq = sq + (columns[axis] - query[axis]) ** 2
    # Integers of the same bits order alike, and XLA vectorises their minimum. The
    # row in the low bits tells equal distances apart.
    bits_type = jnp.int32 if columns.dtype == jnp.float32 else jnp.int64
    far = jnp.asarray(jnp.iinfo(bits_type).max, bits_type)
    row_mask = (1 << min((n - 1).bit_length(), 18)) - 1
    rows = jnp.arange(n, dtype=bits_type) & row_mask
    keys = (lax.bitcast_convert_type(sq, bits_type) & ~row_mask) | rows
    keys = jnp.where(mask & (sq > 0), keys, far)

    def next_nearest(_: Array, last: Array) -> Array:
        nearest = jnp.min(jnp.where(keys > last, keys, far))
        return jnp.where(nearest < far, nearest, last)

    last = control.fori_loop(0, 2 * (d - 1), next_nearest, jnp.full((), -1, bits_type))
    return jnp.where(last >= 0, last & row_mask, -1).astype(jnp.int32)
