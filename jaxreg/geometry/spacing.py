"""How densely a cloud is sampled."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import spread_rows
from jaxreg._core.typing import Mask, Points


_SAMPLES = 64


def median_spacing(points: Points, mask: Mask) -> Float[Array, ""]:
    """The spacing of the samples: on a regular grid its step.

    The median distance from a valid point to its second other point on a curve, its
    fourth on a surface: the nearest one tells little of random samples. Measured from
    64 valid rows spread over the array; duplicates of a point are skipped.

    Gradients: cut.
    """
    points = lax.stop_gradient(points)
    at, use = spread_rows(mask, _SAMPLES)
    columns = points.T
    other = lax.map(lambda row: _distance_to_other(points[row], columns, mask), at)
    use = use & (other > 0)
    spacing = jnp.nanmedian(jnp.where(use, other, jnp.nan))
    return jnp.where(jnp.any(use), spacing, 0)


def _distance_to_other(
    query: Float[Array, " d"], columns: Float[Array, "d n"], mask: Mask
) -> Float[Array, ""]:
    """Distance to the second (2D) or fourth (3D) nearest other point, or the last."""
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

    last = lax.fori_loop(0, 2 * (d - 1), next_nearest, jnp.full((), -1, bits_type))
    distance = jnp.sqrt(jnp.sum((query - columns[:, last & row_mask]) ** 2))
    return jnp.where(last >= 0, distance, 0)
