"""Exact closest points by comparing every pair, tile by tile.

The oracle of all other indexes, and the fastest exact search on CPU up to a few
thousand targets. XLA vectorises a float `min` but not `argmin`, so the row is carried
through the `min`: the low mantissa bits of a squared distance are replaced by the
number of the target within its tile. Targets whose distances agree in all the bits
that are left are told apart by a second `min`, over the bits that were replaced, so
the answer is exact. `python -m bench.neighbours` measures it beside its peers.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Mask, Points
from jaxreg.neighbours.base import AbstractIndex


# Rows within a tile fit in 12 bits, so that (12 low bits, row) is exact in a float32.
_ROW_BITS = 12
_TARGET_TILE = 1 << _ROW_BITS
_QUERY_TILE = 128


class BruteForce(AbstractIndex):
    """Exact search over all targets; O(n + m) memory, O(n m) time.

    Ties go to the lowest row. Distances beyond the float range are clamped.
    """

    points: Float[Array, "m d"]
    mask: Bool[Array, " m"]

    @classmethod
    def build(cls, points: Points, mask: Mask | None = None) -> "BruteForce":
        """Stores the points; there is nothing to prepare."""
        if mask is None:
            mask = jnp.ones(points.shape[:1], dtype=bool)
        return cls(points, mask)

    def lookup(self, columns: Float[Array, "d n"]) -> Int[Array, " n"]:
        """The closest valid target of each query, exactly."""
        d, n = columns.shape
        tile = min(_QUERY_TILE, n)
        padded = jnp.pad(columns, ((0, 0), (0, -n % tile)), mode="edge")
        # Which target is closest has no gradient.
        coords, penalty, first = _target_tiles(
            lax.stop_gradient(self.points), self.mask
        )
        queries = jnp.swapaxes(padded.reshape(d, -1, tile), 0, 1)
        queries = lax.stop_gradient(queries)

        # Targets outside, queries inside: a tile of targets is sliced out once and
        # stays in the cache; the other order runs ten times slower on CPU.
        def step(best: tuple[Array, Array], target: tuple[Array, ...]):
            row, sq = lax.map(lambda q: _closest_in_tile(q, *target[:2]), queries)
            better = sq < best[1]
            row = jnp.where(better, row + target[2], best[0])
            return (row, jnp.where(better, sq, best[1])), None

        start = (
            jnp.zeros(queries.shape[::2], jnp.int32),
            jnp.full(queries.shape[::2], jnp.inf, queries.dtype),
        )
        row = lax.scan(step, start, (coords, penalty, first))[0][0]
        return jnp.minimum(row.reshape(-1)[:n], len(self.mask) - 1)


def _target_tiles(points: Array, mask: Array) -> tuple[Array, Array, Array]:
    """Coordinates `(t, d, width)`, penalty `(t, width)`, first row `(t,)` of tiles."""
    m = points.shape[0]
    width = min(_TARGET_TILE, m)
    pad = -m % width
    far = jnp.finfo(points.dtype).max / 8
    penalty = jnp.where(mask, 0, far).astype(points.dtype)
    penalty = jnp.pad(penalty, (0, pad), constant_values=far)
    coords = jnp.pad(jnp.where(mask[:, None], points, 0), ((0, pad), (0, 0)))
    coords = jnp.swapaxes(coords.reshape(-1, width, points.shape[1]), 1, 2)
    first = jnp.arange(coords.shape[0], dtype=jnp.int32) * width
    return coords, penalty.reshape(-1, width), first


def _closest_in_tile(
    queries: Array, coords: Array, penalty: Array
) -> tuple[Array, Array]:
    dtype = queries.dtype
    bits_type = jnp.int32 if dtype == jnp.float32 else jnp.int64
    info = jnp.finfo(dtype)
    # Unrolled over d: XLA vectorises this, not a reduction over an axis of length 3.
    sq = jnp.broadcast_to(penalty, (queries.shape[1], penalty.shape[0]))
    for k in range(queries.shape[0]):
        sq = sq + (queries[k, :, None] - coords[k]) ** 2
    # Normal finite numbers only: zero would make the row a denormal, inf a NaN.
    bits = lax.bitcast_convert_type(jnp.clip(sq, info.tiny, info.max / 4), bits_type)
    low = bits_type((1 << _ROW_BITS) - 1)
    rows = jnp.arange(coords.shape[-1], dtype=bits_type)

    tagged = lax.bitcast_convert_type((bits & ~low) | rows, dtype)
    best = lax.bitcast_convert_type(jnp.min(tagged, axis=1), bits_type) & ~low
    # Among targets that agree in the high bits: least low bits, then least row.
    tie = ((bits & low) * (1 << _ROW_BITS) + rows).astype(jnp.float32)
    tie = jnp.where((bits & ~low) == best[:, None], tie, jnp.float32(1 << 25))
    code = jnp.min(tie, axis=1).astype(bits_type)
    exact = best | (code >> _ROW_BITS)
    row = (code & low).astype(jnp.int32)
    return row, lax.bitcast_convert_type(exact, dtype)
