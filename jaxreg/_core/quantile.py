"""Quantiles of masked numbers: of non-negative ones by bisection, without sorting.

The bits of a non-negative float, read as an integer, grow with the float. So the
quantile is found bit by bit, each by one count of the values below a threshold.
`jnp.nanquantile`, which sorts, takes 12 to 35 times as long on one CPU core (2,000
and 100,000 values in float32: 0.4 to 0.9 against 0.04 ms, 42 to 52 against 1.4 to
2.4 ms). Two bits a round by three counts gain nothing (0.03 and 2.2 ms), four
bits lose.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control


def masked_quantile(
    x: Float[Array, " n"], mask: Bool[Array, " n"], share: Float[Array, ""] | float
) -> Float[Array, ""]:
    """The least valid value that at least `share` of the valid values do not exceed.

    Args:
        x: `(n,)` values, float32 or float64; valid ones are at least 0 and not NaN.
        mask: `(n,)` which of them are valid.
        share: in [0, 1]: zero gives the least value, one the greatest. Its product
            with the number of values counts as an integer if it is one up to rounding.

    Returns:
        One of the valid values, in the dtype of `x`; zero where nothing is valid.

    Gradients: of that value alone, at the row where it was found.
    """
    count = jnp.sum(mask, dtype=jnp.int32)
    total = count.astype(x.dtype)
    wanted = jnp.asarray(share, x.dtype) * total * (1 - 4 * jnp.finfo(x.dtype).eps)
    rank = jnp.clip(jnp.ceil(wanted), 1, jnp.maximum(total, 1)).astype(jnp.int32)
    return _one_of(x, mask, _value_of(lax.stop_gradient(x), mask, rank))


def nearest_rank(
    x: Float[Array, " n"], mask: Bool[Array, " n"], q: float | Array
) -> Float[Array, ""]:
    """The value at quantile q of the valid ones (nearest rank): as `masked_quantile`.

    Ranks are counted from the least value, at 0, to the greatest, at 1.
    """
    count = jnp.sum(mask, dtype=jnp.int32)
    rank = jnp.floor(q * (count - 1).astype(x.dtype) + 0.5).astype(jnp.int32)
    rank = jnp.maximum(rank, 0) + 1
    return _one_of(x, mask, _value_of(lax.stop_gradient(x), mask, rank))


@jax.custom_jvp
def _one_of(x: Array, mask: Array, value: Array) -> Array:
    """The value, as a function of the row of x that holds it."""
    return value


@_one_of.defjvp
def _one_of_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    x, mask, value = primals
    found = mask & (jnp.abs(lax.stop_gradient(x)) == value)
    slope = jnp.where(jnp.any(found), tangents[0][jnp.argmax(found)], 0)
    return _one_of(x, mask, value), slope


def _value_of(
    x: Float[Array, " n"], mask: Bool[Array, " n"], rank: Int[Array, ""]
) -> Float[Array, ""]:
    """The valid value of a rank, counted from 1: bit by bit."""
    kind, bits = (jnp.int32, 31) if x.dtype == jnp.float32 else (jnp.int64, 63)
    # abs: the sign bit of -0.0 would make it the least integer.
    keys = lax.bitcast_convert_type(jnp.abs(x), kind)
    keys = jnp.where(mask, keys, jnp.iinfo(kind).max)

    def set_bit(k: Array, found: Array) -> Array:
        # The greatest key with fewer than `rank` values below it is the answer.
        trial = found + (jnp.ones((), kind) << (bits - 1 - k).astype(kind))
        below = jnp.sum(keys < trial, dtype=jnp.int32)
        return jnp.where(below < rank, trial, found)

    found = control.fori_loop(0, bits, set_bit, jnp.zeros((), kind))
    return jnp.where(jnp.any(mask), lax.bitcast_convert_type(found, x.dtype), 0)
