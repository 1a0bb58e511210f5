"""Residual resampling."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import place_among, traced
from jaxreg._core.typing import Key
from jaxreg.particle.resamplers.base import AbstractHardResampler, rows_at


class Residual(AbstractHardResampler):
    """floor(num * weight_i) copies of each, the rest drawn with what is left over.

    Liu and Chen 1998: the rest is multinomial with num * weight_i minus its floor.

    Attributes:
        threshold: see `AbstractHardResampler`.
    """

    threshold: Array | float = traced(1.0)

    def draw(
        self, key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
    ) -> Int[Array, " p"]:
        """Ancestors."""
        share = num * weight
        whole = jnp.floor(share)
        place = jnp.arange(weight.shape[0], dtype=weight.dtype)
        rows = place_among(jnp.cumsum(whole), place, "right")
        u = jax.random.uniform(key, weight.shape, weight.dtype)
        rest = rows_at(share - whole, u)
        return jnp.where(place < jnp.sum(whole), rows, rest).astype(jnp.int32)
