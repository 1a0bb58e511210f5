"""Sums over all pairs of two point sets under a Gaussian kernel, tile by tile.

The kernel's values of a tile times the monomials of the other set are one matrix
product, which gives the moments up to second order together: from them follow the
value, the gradient and the exact Hessian of the kernel correlation, at nearly the
price of its value.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float


# Pairs of a tile: their kernel values stay in a CPU's second cache.
_PAIRS = 1 << 16


class PairSums(eqx.Module):
    """For every point x of one set, sums over all points q of the other.

    With k = exp(-|q - x|^2 / (2 bandwidth^2)):

    Attributes:
        value: `(n,)` sum of k.
        pull: `(d, n)` sum of k (q - x).
        spread: `(d, d, n)` sum of k (q - x)(q - x)^T.
    """

    value: Float[Array, " n"]
    pull: Float[Array, "d n"]
    spread: Float[Array, "d d n"]


def pair_sums(
    at: Float[Array, "d n"],
    at_mask: Bool[Array, " n"],
    others: Float[Array, "m d"],
    others_mask: Bool[Array, " m"],
    bandwidth: Float[Array, ""],
) -> PairSums:
    """Moments of the kernel around each point, in O(n + m) memory and O(n m) time.

    Args:
        at: `(d, n)` points to sum for.
        at_mask: `(n,)` False: the sums of that point are zero.
        others: `(m, d)` points to sum over, not far from the origin.
        others_mask: `(m,)` False: not summed over.
        bandwidth: width of the Gaussian, in the unit of the points.

    Gradients: exact, in all but the masks, in the same memory.
    """
    d, n = at.shape
    upper = [(i, j) for i in range(d) for j in range(i, d)]
    columns = others.T
    monomials = jnp.stack(
        [jnp.ones_like(columns[0]), *columns]
        + [columns[i] * columns[j] for i, j in upper],
        axis=1,
    )
    monomials = jnp.where(others_mask[:, None], monomials, 0)

    @jax.checkpoint
    def of_tile(tile: Float[Array, "d t"]) -> Float[Array, "t p"]:
        k = _kernel(tile, columns, bandwidth)
        return jnp.matmul(k, monomials, precision=lax.Precision.HIGHEST)

    sums = _by_tiles(of_tile, at, others.shape[0])[:n]
    sums = jnp.where(at_mask[:, None], sums, 0)
    value, first = sums[:, 0], sums[:, 1 : d + 1].T
    spread: list[list[Array]] = [[value] * d for _ in range(d)]
    for p, (i, j) in enumerate(upper):
        second = sums[:, d + 1 + p] - at[i] * first[j] - at[j] * first[i]
        spread[i][j] = spread[j][i] = second + at[i] * at[j] * value
    pull = first - at * value[None]
    return PairSums(value, pull, jnp.stack([jnp.stack(row) for row in spread]))


def kernel_correlation(
    source: Float[Array, "n d"],
    target: Float[Array, "m d"],
    bandwidth: Float[Array, ""] | float,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, ""]:
    """The sum of exp(-|p - q|^2 / (2 bandwidth^2)) over all pairs of valid points.

    Args:
        source: `(n, d)` points p, moved already.
        target: `(m, d)` points q, of the same dtype.
        bandwidth: in the unit of the points.
        source_mask: `(n,)` True for valid points; None for all.
        target_mask: `(m,)` likewise.

    Gradients: exact, in O(n + m) memory.

    Reference: Tsin and Kanade 2004. Up to a constant factor it is the correlation of
    the two sets' densities, each smoothed by a Gaussian of width bandwidth / sqrt(2).
    """
    columns = target.T
    width = jnp.asarray(bandwidth, source.dtype)

    @jax.checkpoint
    def of_tile(tile: Float[Array, "d t"]) -> Float[Array, " t"]:
        k = _kernel(tile, columns, width)
        if target_mask is not None:
            k = jnp.where(target_mask[None], k, 0)
        return jnp.sum(k, axis=1)

    value = _by_tiles(of_tile, source.T, target.shape[0])[: source.shape[0]]
    return jnp.sum(value if source_mask is None else jnp.where(source_mask, value, 0))


def _kernel(
    tile: Float[Array, "d t"], columns: Float[Array, "d m"], bandwidth: Array
) -> Float[Array, "t m"]:
    sq = (tile[0][:, None] - columns[0][None]) ** 2
    for axis in range(1, columns.shape[0]):
        sq = sq + (tile[axis][:, None] - columns[axis][None]) ** 2
    return jnp.exp(sq * (-0.5 / bandwidth**2))


def _by_tiles(fn, at: Float[Array, "d n"], m: int) -> Array:
    """`fn` of tiles `(d, t)` of the points, one below the other, with padding."""
    d, n = at.shape
    rows = min(max(_PAIRS // m, 1), n)
    tiles = -(-n // rows)
    rows = -(-n // tiles)
    padded = jnp.pad(at, ((0, 0), (0, tiles * rows - n)))
    out = lax.map(fn, jnp.swapaxes(padded.reshape(d, tiles, rows), 0, 1))
    return out.reshape(tiles * rows, *out.shape[2:])
