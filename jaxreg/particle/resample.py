"""Weights and resampling (PF paper, section 3.4)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Key


def effective_sample_size(weight: Float[Array, " p"]) -> Float[Array, ""]:
    """1 / sum w^2 of normalised weights: between 1 and p."""
    return 1 / jnp.sum(weight**2)


def tempered_weights(
    energy: Float[Array, " p"], target_size: Array | float
) -> Float[Array, " p"]:
    """Normalised exp(-energy / temperature) with a given effective sample size.

    The paper's literal exponent, a sum over all points, underflows (and has the wrong
    sign); here the energies themselves set the temperature. Where all energies are
    equal or none is finite, the weights are uniform.
    """
    finite = jnp.isfinite(energy)
    low = jnp.min(jnp.where(finite, energy, jnp.inf))
    excess = jnp.where(finite, energy - jnp.where(jnp.isfinite(low), low, 0), jnp.inf)
    span = jnp.max(jnp.where(finite, excess, 0))
    span = jnp.where(span > 0, span, 1)

    def weights(temperature: Array) -> Array:
        weight = jnp.exp(-excess / temperature)
        total = jnp.sum(weight)
        uniform = jnp.full_like(weight, 1 / weight.size)
        return jnp.where(total > 0, weight / jnp.where(total > 0, total, 1), uniform)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        cold, hot = bounds
        middle = jnp.sqrt(cold * hot)
        small = effective_sample_size(weights(middle)) < target_size
        return jnp.where(small, middle, cold), jnp.where(small, hot, middle)

    return weights(lax.fori_loop(0, 24, halve, (span * 1e-4, span * 1e3))[1])


def systematic(
    key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
) -> Int[Array, " p"]:
    """Ancestors drawn by systematic resampling: one uniform number for all.

    The expected number of copies of i is num * weight_i, the actual one is that
    rounded up or down.

    Args:
        key: randomness.
        weight: `(p,)`, any scale.
        num: how many to draw, at most p; rows of the result beyond it mean nothing.
    """
    cumulative = jnp.cumsum(weight)
    cumulative = cumulative / cumulative[-1]
    start = jax.random.uniform(key, (), weight.dtype)
    at = (jnp.arange(weight.shape[0], dtype=weight.dtype) + start) / num
    rows = jnp.searchsorted(cumulative, at, side="right")
    return jnp.minimum(rows, weight.shape[0] - 1).astype(jnp.int32)
