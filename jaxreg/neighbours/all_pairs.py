"""Exact closest points on an accelerator: all pairs in one reduction.

Tiles and boxes save comparisons and serve the caches of a CPU. On an accelerator each
turn of a loop waits for the start of some kernels, about as long as ten million
comparisons take. Here the compiler computes distances inside the reduction, so that
nothing of the size of all pairs is kept.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control


# Pairs compared at a time for k > 1, as not all of that is fused: 64 MB of distances.
_PAIRS = 1 << 24
# Of so many at most each is found in turn; `lax.top_k` sorts whole rows.
_FEW = 16


def closest(
    columns: Float[Array, "d n"], points: Float[Array, "d m"]
) -> Int[Array, " n"]:
    """The row of the first closest point of each query.

    Args:
        columns: queries.
        points: inf where there is none.
    """
    return jnp.argmin(_sq_distance(columns, points), axis=1).astype(jnp.int32)


def nearest(
    columns: Float[Array, "d n"], points: Float[Array, "d m"], k: int
) -> Int[Array, "k n"]:
    """The rows of the k closest points, ascending; -1 for surplus."""
    d, n = columns.shape
    size = max(min(_PAIRS // points.shape[1], n), 1)
    tiles = -(-n // size)
    padded = jnp.pad(columns, ((0, 0), (0, tiles * size - n)))
    tiled = jnp.swapaxes(padded.reshape(d, tiles, size), 0, 1)

    def of_tile(queries: Float[Array, "d t"]) -> Int[Array, "k t"]:
        return _least(_sq_distance(queries, points), min(k, points.shape[1]))

    rows = jnp.moveaxis(lax.map(of_tile, tiled), 0, 1).reshape(-1, tiles * size)
    return jnp.pad(rows[:, :n], ((0, k - len(rows)), (0, 0)), constant_values=-1)


def _sq_distance(columns: Array, points: Array) -> Float[Array, "n m"]:
    sq = (columns[0][:, None] - points[0][None]) ** 2
    for x, y in zip(columns[1:], points[1:], strict=True):
        sq = sq + (x[:, None] - y[None]) ** 2
    return sq


def _least(sq: Float[Array, "t m"], k: int) -> Int[Array, "k t"]:
    """Columns of the k least of each row, ascending, ties to the first; -1: inf."""
    if k > _FEW:
        least, rows = lax.top_k(-sq, k)
        return jnp.where(least > -jnp.inf, rows, -1).T
    number = jnp.arange(sq.shape[1], dtype=jnp.int32)[None]

    def next_one(found: Int[Array, "k t"], at: Array) -> tuple[Array, None]:
        # By number: a distance computed once more may be rounded in another way.
        taken = jnp.any(found[:, :, None] == number[None], axis=0)
        left = jnp.where(taken, jnp.inf, sq)
        row = jnp.argmin(left, axis=1).astype(jnp.int32)
        row = jnp.where(jnp.min(left, axis=1) < jnp.inf, row, -1)
        return found.at[at].set(row), None

    none = jnp.full((k, sq.shape[0]), -1, jnp.int32)
    return control.scan(next_one, none, jnp.arange(k, dtype=jnp.int32))[0]
