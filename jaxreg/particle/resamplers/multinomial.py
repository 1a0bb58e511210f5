"""Multinomial resampling."""

import jax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.particle.resamplers.base import AbstractHardResampler, rows_at


class Multinomial(AbstractHardResampler):
    """Each ancestor drawn independently: P(i) = weight_i.

    Gordon, Salmond, Smith 1993 (the PF paper, section 3.3, step 3): the number of
    copies is binomial, the largest variance of the four.

    Attributes:
        threshold: see `AbstractHardResampler`.
    """

    threshold: Array | float = traced(1.0)

    def draw(
        self, key: Key, weight: Float[Array, " p"], num: Int[Array, ""] | int
    ) -> Int[Array, " p"]:
        """Ancestors."""
        del num  # independent draws: any number of them may be taken
        return rows_at(weight, jax.random.uniform(key, weight.shape, weight.dtype))
