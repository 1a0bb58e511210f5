"""`PointCloud`: points with normals and a mask, thinned and described inside `jit`."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Mask, Points


# Rows of a (queries, points) block of distances; bounds memory to 16 MB at 16k points.
_TILE = 256
# A voxel coordinate fits in 10 bits: 3 of them make an int32 key.
_MAX_CELLS = 1 << 10


class PointCloud(eqx.Module):
    """Points of which `mask` are valid, with unoriented unit normals.

    Attributes:
        points: `(n, d)`.
        normals: `(n, d)` unit normals of either sign; zero where undefined.
        mask: `(n,)` True for valid points.
    """

    points: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    mask: Bool[Array, " n"]


def centroid(points: Points, mask: Mask) -> Float[Array, " d"]:
    """The mean of the valid points (zero where there are none)."""
    weight = mask.astype(points.dtype)
    first = points[jnp.argmax(mask)]  # sums of differences: safe far from the origin
    mean = jnp.sum(weight[:, None] * (points - first), axis=0)
    return first + mean / jnp.maximum(jnp.sum(weight), 1)


def rms_radius(points: Points, mask: Mask) -> Float[Array, ""]:
    """Root mean square distance of the valid points from their centroid."""
    offset = jnp.where(mask[:, None], points - centroid(points, mask), 0)
    num = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    return jnp.sqrt(jnp.sum(offset**2) / num)


def nearest_rows(
    queries: Float[Array, "q d"], points: Points, mask: Mask, k: int
) -> tuple[Int[Array, "q k"], Float[Array, "q k"]]:
    """Rows and squared distances of the k nearest valid points, by brute force.

    Tiled over the queries. Where fewer than k points are valid, the squared distance
    of the surplus rows is inf.
    """
    n = queries.shape[0]
    tile = min(_TILE, n)
    padded = jnp.pad(queries, ((0, -n % tile), (0, 0)), mode="edge")

    def of_tile(block: Array) -> tuple[Array, Array]:
        sq = jnp.zeros((tile, points.shape[0]), points.dtype)
        for axis in range(points.shape[1]):
            sq = sq + (block[:, axis, None] - points[:, axis]) ** 2
        value, row = lax.top_k(jnp.where(mask, -sq, -jnp.inf), k)
        return row, -value

    row, sq = lax.map(of_tile, padded.reshape(-1, tile, points.shape[1]))
    return row.reshape(-1, k)[:n], sq.reshape(-1, k)[:n]


def median_spacing(points: Points, mask: Mask) -> Float[Array, ""]:
    """The spacing of the samples: on a regular grid its step.

    The median distance from a valid point to its second other point on a curve, its
    fourth on a surface: the nearest one tells little of random samples. Measured from
    256 rows spread over the array; duplicates of a point are skipped.
    """
    at = jnp.linspace(0, points.shape[0] - 1, min(256, points.shape[0])).astype(
        jnp.int32
    )
    order = jnp.argsort(~mask, stable=True)  # valid rows first
    num = jnp.maximum(jnp.sum(mask), 1)
    at = order[at * num // points.shape[0]]
    rank = 2 * (points.shape[1] - 1)
    _, sq = nearest_rows(points[at], points, mask, min(2 * rank, points.shape[0]))
    others = jnp.sort(jnp.where(sq > 0, sq, jnp.inf), axis=1)[:, :rank]
    other = jnp.max(jnp.where(jnp.isfinite(others), others, 0), axis=1)
    use = mask[at] & (other > 0)
    spacing = jnp.nanmedian(jnp.where(use, jnp.sqrt(other), jnp.nan))
    return jnp.where(jnp.any(use), spacing, 0)


def _voxel_keys(points: Array, mask: Array, low: Array, size: Array) -> Array:
    at = jnp.clip((points - low) / size, 0, _MAX_CELLS - 1).astype(jnp.int32)
    key = at[:, 0]
    for axis in range(1, points.shape[1]):
        key = key * _MAX_CELLS + at[:, axis]
    return jnp.where(mask, key, jnp.iinfo(jnp.int32).max)


def _number_of_voxels(keys: Array) -> Array:
    ordered = jnp.sort(keys)
    new = jnp.concatenate([jnp.ones(1, bool), ordered[1:] != ordered[:-1]])
    return jnp.sum(new & (ordered != jnp.iinfo(jnp.int32).max))


def _voxel_size(points: Array, mask: Array, low: Array, side: Array, cap: int) -> Array:
    """The smallest voxel, to 1 %, that leaves at most `cap` voxels filled."""

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        small, large = bounds
        middle = jnp.sqrt(small * large)
        fits = _number_of_voxels(_voxel_keys(points, mask, low, middle)) <= cap
        return jnp.where(fits, small, middle), jnp.where(fits, middle, large)

    return lax.fori_loop(0, 10, halve, (side / (_MAX_CELLS - 1), side))[1]


def thin(
    points: Points, mask: Mask, capacity: int, *, neighbours: int = 10
) -> PointCloud:
    """At most `capacity` points, evenly spread, with normals from all the points.

    Points that share a voxel are replaced by their mean; the voxel is chosen as small
    as the capacity allows. A cloud that fits is kept as it is. A normal is the
    direction of least spread of all the points in the `neighbours` nearest voxels.

    Args:
        points: `(n, d)`.
        mask: `(n,)` True for valid points.
        capacity: static number of rows of the result; rows that are not needed are
            masked.
        neighbours: voxels that share in a normal.

    Gradients: with respect to the points through the means; normals are cut.
    """
    n, d = points.shape
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    side = jnp.max(high - low)
    low = lax.stop_gradient(jnp.where(jnp.isfinite(low), low, 0))
    side = lax.stop_gradient(jnp.where(jnp.isfinite(side) & (side > 0), side, 1))
    frozen = lax.stop_gradient(points)
    if n <= capacity:
        group = jnp.arange(n)
        capacity = n
    else:
        size = _voxel_size(frozen, mask, low, side, capacity)
        keys = _voxel_keys(frozen, mask, low, size)
        order = jnp.argsort(keys)
        ordered = keys[order]
        new = jnp.concatenate([jnp.zeros(1, bool), ordered[1:] != ordered[:-1]])
        group = jnp.zeros(n, jnp.int32).at[order].set(jnp.cumsum(new, dtype=jnp.int32))
        group = jnp.where(mask, group, capacity)  # dropped by the segment sums
    weight = mask.astype(points.dtype)
    count = jax.ops.segment_sum(weight, group, capacity)
    safe = jnp.maximum(count, 1)[:, None]
    local = jnp.where(mask[:, None], points - low, 0)
    mean = jax.ops.segment_sum(local, group, capacity) / safe
    offset = lax.stop_gradient(local - mean[jnp.minimum(group, capacity - 1)])
    spread = jax.ops.segment_sum(
        weight[:, None, None] * offset[:, :, None] * offset[:, None, :],
        group,
        capacity,
    )
    valid = count > 0
    normals = _normals(lax.stop_gradient(mean), count, spread, valid, neighbours)
    return PointCloud(jnp.where(valid[:, None], mean + low, 0), normals, valid)


def estimate_normals(points: Points, mask: Mask, *, neighbours: int = 10) -> Points:
    """Unit normals from the `neighbours` nearest points; zero where undefined.

    The sign is arbitrary. Gradients: cut.
    """
    d = points.shape[1]
    frozen = lax.stop_gradient(points - centroid(points, mask))
    count = mask.astype(points.dtype)
    spread = jnp.zeros((points.shape[0], d, d), points.dtype)
    return _normals(frozen, count, spread, mask, neighbours)


def _normals(
    mean: Array, count: Array, spread: Array, valid: Array, neighbours: int
) -> Array:
    """Normals of groups of points given by count, mean and sum of outer products."""
    d = mean.shape[1]
    row, sq = nearest_rows(mean, mean, valid, min(neighbours, mean.shape[0]))
    weight = jnp.where(jnp.isfinite(sq), count[row], 0)
    total = jnp.maximum(jnp.sum(weight, axis=1), 1)[:, None]
    delta = mean[row] - mean[:, None]
    centre = jnp.sum(weight[..., None] * delta, axis=1) / total
    delta = delta - centre[:, None]
    covariance = jnp.einsum("nk,nki,nkj->nij", weight, delta, delta)
    covariance = covariance + jnp.sum(
        jnp.where(weight[..., None, None] > 0, spread[row], 0), axis=1
    )
    values, vectors = jnp.linalg.eigh(covariance)
    # A plane (a line in 2D) needs spread in all but one direction.
    flat = valid & (values[:, 1] > 1e-6 * values[:, -1]) & (values[:, -1] > 0)
    if d == 2:
        flat = valid & (values[:, -1] > 0)
    return jnp.where(flat[:, None], vectors[:, :, 0], 0)
