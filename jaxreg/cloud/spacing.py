"""How densely a cloud is sampled."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.typing import Mask, Points


_SAMPLES = 64
# Rows of a block of distances that stays in a CPU's cache.
_TILE = 16


def median_spacing(points: Points, mask: Mask) -> Float[Array, ""]:
    """The spacing of the samples: on a regular grid its step.

    The median distance from a valid point to its second other point on a curve, its
    fourth on a surface: the nearest one tells little of random samples. Measured from
    64 rows spread over the array; duplicates of a point are skipped.

    Gradients: cut.
    """
    points = lax.stop_gradient(points)
    n = points.shape[0]
    num = min(_SAMPLES, -(-n // _TILE) * _TILE)
    at = jnp.linspace(0, n - 1, num).astype(jnp.int32)
    # The valid row of that rank; searched, not sorted.
    count = jnp.cumsum(mask.astype(jnp.int32))
    rank = (at * count[-1]) // n + 1
    at = jnp.minimum(jnp.searchsorted(count, rank), n - 1)
    other = lax.map(
        lambda rows: _distance_to_other(points[rows].T, points.T, mask),
        at.reshape(-1, _TILE),
    ).reshape(-1)
    use = mask[at] & (other > 0)
    spacing = jnp.nanmedian(jnp.where(use, other, jnp.nan))
    return jnp.where(jnp.any(use), spacing, 0)


def _distance_to_other(
    queries: Float[Array, "d t"], points: Float[Array, "d n"], mask: Mask
) -> Float[Array, " t"]:
    """Distance to the second (2D) or fourth (3D) nearest other point, or the last."""
    d, n = points.shape
    sq = jnp.zeros((queries.shape[1], n), points.dtype)
    for axis in range(d):
        sq = sq + (queries[axis][:, None] - points[axis]) ** 2
    # Integers of the same bits order alike, and XLA vectorises their minimum. The
    # row in the low bits tells equal distances apart.
    bits_type = jnp.int32 if points.dtype == jnp.float32 else jnp.int64
    far = jnp.asarray(jnp.iinfo(bits_type).max, bits_type)
    row_mask = (1 << min((n - 1).bit_length(), 18)) - 1
    rows = jnp.arange(n, dtype=bits_type) & row_mask
    keys = (lax.bitcast_convert_type(sq, bits_type) & ~row_mask) | rows
    keys = jnp.where(mask & (sq > 0), keys, far)
    last = jnp.full(queries.shape[1], -1, bits_type)
    for _ in range(2 * (d - 1)):
        nearest = jnp.min(jnp.where(keys > last[:, None], keys, far), axis=1)
        last = jnp.where(nearest < far, nearest, last)
    other = points[:, last & row_mask]
    distance = jnp.sqrt(jnp.sum((queries - other) ** 2, axis=0))
    return jnp.where(last >= 0, distance, 0)
