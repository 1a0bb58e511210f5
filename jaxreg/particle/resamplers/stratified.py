"""Stratified resampling."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.particle.resamplers.base import AbstractHardResampler, rows_at


class Stratified(AbstractHardResampler):
    """Row i where the cumulated weight passes (i + u_i) / num, u_i ~ U(0, 1) each.

    Kitagawa 1996. The number of copies differs from num * weight by less than two.

    Attributes:
        threshold: see `AbstractHardResampler`.
    """

    threshold: Array | float = traced(1.0)

    def draw(
        self, key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
    ) -> Int[Array, " p"]:
        """Ancestors."""
        p, dtype = weight.shape[0], weight.dtype
        start = jax.random.uniform(key, (p,), dtype)
        return rows_at(weight, (jnp.arange(p, dtype=dtype) + start) / num)
