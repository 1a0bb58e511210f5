"""Systematic resampling."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.particle.resamplers.base import AbstractHardResampler, rows_at


class Systematic(AbstractHardResampler):
    """Row i where the cumulated weight passes (i + u) / num, one u ~ U(0, 1) for all.

    Kitagawa 1996; what the PF paper takes from its reference [18]. The number of copies
    is num * weight rounded up or down: the least variance of the four.

    Attributes:
        threshold: see `AbstractHardResampler`.
    """

    threshold: Array | float = traced(1.0)

    def draw(
        self, key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
    ) -> Int[Array, " p"]:
        """Ancestors."""
        p, dtype = weight.shape[0], weight.dtype
        start = jax.random.uniform(key, (), dtype)
        return rows_at(weight, (jnp.arange(p, dtype=dtype) + start) / num)
