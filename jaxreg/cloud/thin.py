"""Fewer points, evenly spread, with normals from all of them."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxreg._core.typing import Mask, Points
from jaxreg.cloud.cells import UNUSED, at_most, cell_size, cells_in_order
from jaxreg.cloud.nearest_normals import normals_from_neighbours
from jaxreg.cloud.normals import normals_from_cells
from jaxreg.cloud.point_cloud import PointCloud
from jaxreg.geometry.boxes import bounding_cube


# Points in a cell of the size that normals are estimated with, where none are merged.
_POINTS_PER_CELL = 1.6
# Share of the cells that are filled in the first attempt to fill at most so many.
_FULL = 0.95
# Points in a merged cell from which on its own moments tell the normal.
_MANY = 4


def thin(
    points: Points,
    mask: Mask,
    capacity: int,
    num_neighbours: int | None = None,
    fading: bool = False,
) -> PointCloud:
    """At most `capacity` points in spatial order, with normals from all the points.

    And with the spacing around each, where neighbours are searched for.

    Points that share a cell are replaced by their mean; the cell is chosen as small
    as the capacity allows. A cloud whose valid points fit keeps them.

    Args:
        points: `(n, d)`.
        mask: `(n,)` True for valid points.
        capacity: static number of rows of the result; rows that are not needed are
            masked.
        num_neighbours: static; normals are estimated from the points around that many
            nearest places, or by `estimate_normals`' cells, ten times faster.
        fading: static; the farther of these count less, and the farthest nothing, so
            that normals are continuous in the points.

    Gradients: by the points, of the means and, after `followed`, the normals; which
    cell a point is in, and so which points are merged, is held. The spacing around each
    is cut.
    """
    n = points.shape[0]
    merge = n > capacity
    low, size, rows, keys = _cells(points, mask, capacity if merge else None)
    ordered, valid = points[rows] - low[None], mask[rows]
    places = jnp.where(valid[:, None], ordered, 0)
    samples, num = places, jnp.sum(mask)
    cell = jnp.arange(n, dtype=jnp.int32)
    if merge:
        cell = jnp.where(num > capacity, _cell_numbers(keys), cell)
    count = valid.astype(points.dtype)
    if merge:
        count = jax.ops.segment_sum(count, cell, capacity)
        total = jax.ops.segment_sum(places, cell, capacity)
        places, valid = total / jnp.maximum(count, 1)[:, None], count > 0
    spacing = window = None
    if num_neighbours is None:
        # Cells that merge many points are windows already.
        finest = jnp.where(num >= _MANY * capacity, 0, 1)
        normals, window = normals_from_cells(places, valid, samples, keys, size, finest)
    else:
        offset = jnp.where(keys[:, None] != UNUSED, samples - places[cell], 0)
        spread = jax.ops.segment_sum(
            offset[:, :, None] * offset[:, None, :], cell, len(valid)
        )
        normals, spacing = normals_from_neighbours(
            places, valid, count, spread, num_neighbours, fading
        )
    points = jnp.where(valid[:, None], places + low[None], 0)
    return PointCloud(points, normals, valid, spacing=spacing, window=window)


def estimate_normals(points: Points, mask: Mask) -> Points:
    """Unit normals of `(n, d)` points from their surroundings; zero where undefined.

    The sign is arbitrary. See `jaxreg.cloud.normals` for the window, and for what their
    gradients hold.
    """
    low, size, rows, keys = _cells(points, mask, None)
    samples = jnp.where(mask[rows, None], points[rows] - low, 0)
    normals, window = normals_from_cells(samples, mask[rows], samples, keys, size, 1)
    normals = window.follow(normals)
    return jnp.zeros_like(normals).at[rows].set(normals)


def _cells(
    points: Array, mask: Array, capacity: int | None
) -> tuple[Array, Array, Array, Array]:
    """Corner and size of cells, rows in the order of the cells' keys, those keys.

    At most `capacity` cells are filled by more points than that; else, the cells are
    half as large as those that hold a few points each.

    Gradients: of corner and size, as the box of the points moves and grows.
    """
    moving = bounding_cube(points, mask)
    frozen, low, side = lax.stop_gradient((points, *moving))
    num = jnp.sum(mask).astype(points.dtype)
    filled = jnp.maximum(num / _POINTS_PER_CELL, 1)
    if capacity is not None:
        filled = jnp.where(num > capacity, _FULL * capacity, filled)
    size = cell_size(frozen, mask, low, side, filled)
    fine = jnp.maximum(size / 2, side / 1000)
    if capacity is None:
        size, (rows, keys) = fine, cells_in_order(frozen, mask, low, fine)
    else:
        size = jnp.where(num > capacity, size, fine)
        size, rows, keys = at_most(capacity, frozen, mask, low, side, size)
    return moving[0], size * (moving[1] / side), rows, keys


def _cell_numbers(keys: Array) -> Array:
    """The number of each point's cell; one too many for points that are not valid."""
    new = (keys[1:] != keys[:-1]).astype(jnp.int32)
    return jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(new)])
