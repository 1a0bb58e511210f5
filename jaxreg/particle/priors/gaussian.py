"""Around a guess."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative, is_concrete
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.local import turn_and_shift
from jaxreg.particle.priors.base import AbstractPrior
from jaxreg.registrar import Frames


class GaussianPrior(AbstractPrior):
    """x_0 ~ N(init, diag(spread^2)) in the tangent space; the first is `init`.

    Without an initial guess, around the identity of the centred clouds.

    Attributes:
        translation_spread: deviation in each direction, in root mean square radii of
            the target.
        rotation_spread: deviation about each axis, in radians.

    Raises: ValueError for negative spreads and where both are zero: then all particles
        are one.
    """

    translation_spread: Array | float = traced(0.3)
    rotation_spread: Array | float = traced(0.3)

    def __check_init__(self) -> None:
        """Refuses spreads that leave a single pose."""
        both = (self.translation_spread, self.rotation_spread)
        check_not_negative(self, "translation_spread", "rotation_spread")
        if all(is_concrete(s) and not np.any(s) for s in both):
            raise ValueError(
                "GaussianPrior: translation_spread and rotation_spread are both 0, "
                "which leaves one particle; use ICP from the guess."
            )

    def in_frames(self, frames: Frames) -> "GaussianPrior":
        """Itself: it holds no poses."""
        return self

    def draw(
        self, key: Key, num: int, d: int, init: Motion | None, dtype: Any
    ) -> Float[Array, "p D D"]:
        """`(num, d+1, d+1)` poses."""
        k = lie.tangent_dim(d)
        init = lie.identity(d, dtype) if init is None else init
        translates = jnp.arange(k) < d
        spread = jnp.where(translates, self.translation_spread, self.rotation_spread)
        tangent = spread.astype(dtype)[None] * jax.random.normal(key, (num, k), dtype)
        return jax.vmap(turn_and_shift, (None, 0))(init, tangent.at[0].set(0))

    def log_density(self, T_target_source: Motion) -> Scalar:
        """Zero: it only says where to begin."""
        return jnp.zeros((), T_target_source.dtype)
