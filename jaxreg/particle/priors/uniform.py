"""No idea of the rotation."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.particle.priors.base import AbstractPrior
from jaxreg.registrar import Frames


class UniformPrior(AbstractPrior):
    """R uniform over SO(d), t ~ N(0, spread^2 I) between the centroids.

    An initial guess, if given, is where the translations are centred.

    Attributes:
        translation_spread: deviation, in root mean square radii of the target.

    Raises: ValueError for a negative spread.
    """

    translation_spread: Array | float = traced(0.5)

    def __check_init__(self) -> None:
        """Refuses a negative spread."""
        check_not_negative(self, "translation_spread")

    def in_frames(self, frames: Frames) -> "UniformPrior":
        """Itself: it holds no poses."""
        return self

    def draw(
        self, key: Key, num: int, d: int, init: Motion | None, dtype: Any
    ) -> Float[Array, "p D D"]:
        """`(num, d+1, d+1)` poses."""
        key_R, key_t = jax.random.split(key)
        R = lie.random_rotations(key_R, num, d, dtype)
        t = self.translation_spread * jax.random.normal(key_t, (num, d), dtype)
        return lie.compose(R, t if init is None else t + lie.translation(init)[None])

    def log_density(self, T_target_source: Motion) -> Scalar:
        """Zero: it only says where to begin."""
        return jnp.zeros((), T_target_source.dtype)
