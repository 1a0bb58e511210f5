"""Points of two clouds that look alike: each the other's nearest in feature space.

Reference: Rusu, Blodow, Beetz 2009, section V (greedy and mutual matches of features);
Lowe 2004, section 7.1 (the ratio to the second nearest).
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg.cloud import Described


class Correspondences(eqx.Module):
    """Points that may be the same, `(m, 3)` each, and normals of either sign there."""

    source: Float[Array, "m 3"]
    source_normals: Float[Array, "m 3"]
    target: Float[Array, "m 3"]
    target_normals: Float[Array, "m 3"]
    mask: Bool[Array, " m"]


def mutual(source: Described, target: Described, num: int) -> Correspondences:
    """Source and target points that are each other's nearest in feature space.

    Of more than `num` those whose nearest is nearest by far, compared to the second.

    Args:
        source: points with features.
        target: likewise.
        num: rows of the result, at most as many as of the source.
    """
    sq = _sq_distances(source, target)
    nearest = jnp.min(sq, axis=1, keepdims=True)
    both = (sq == nearest) & (sq == jnp.min(sq, axis=0)[None]) & jnp.isfinite(sq)
    # Two least numbers and comparisons: XLA vectorises them, not an argmin.
    row = jnp.min(jnp.where(both, _rows(sq)[None], sq.shape[1]), axis=1)
    is_mutual = row < sq.shape[1]
    second = jnp.min(jnp.where(sq == nearest, jnp.inf, sq), axis=1)
    ratio = nearest[:, 0] / jnp.maximum(second, jnp.finfo(sq.dtype).tiny)
    ratio = jnp.where(is_mutual, ratio, jnp.inf)
    use = jnp.argsort(ratio)[:num]
    row = jnp.minimum(row[use], sq.shape[1] - 1)
    return Correspondences(
        source.points[use],
        source.normals[use],
        target.points[row],
        target.normals[row],
        is_mutual[use],
    )


def _rows(sq: Float[Array, "n m"]) -> Int[Array, " m"]:
    return jnp.arange(sq.shape[1], dtype=jnp.int32)


def _sq_distances(source: Described, target: Described) -> Float[Array, "n m"]:
    """Between features, the lesser of both signs; inf where there is none."""

    def inner(a: Array, b: Array) -> Array:
        return jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)

    def size(cloud: Described) -> Array:
        return jnp.sum(cloud.even**2 + cloud.odd**2, axis=1, keepdims=True)

    # The sizes as columns: what is added to a product takes four times as long.
    here, there = size(source), size(target)
    first = jnp.concatenate([-2 * source.even, here, jnp.ones_like(here)], axis=1)
    other = jnp.concatenate([target.even, jnp.ones_like(there), there], axis=1)
    sq = inner(first, other) - jnp.abs(inner(2 * source.odd, target.odd))
    known = source.mask[:, None] & target.mask[None]
    return jnp.where(known, jnp.maximum(sq, 0), jnp.inf)
