"""Where the particles start: pi_0 (PF paper, section 4.2)."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Key, Motion
from jaxreg.geometry import lie
from jaxreg.local import turn_and_shift


def uniform(
    key: Key, num: int, d: int, spread: Array | float, dtype: Any
) -> Float[Array, "p D D"]:
    """Rotations uniform over SO(d), translations normal with deviation `spread`."""
    key_R, key_t = jax.random.split(key)
    R = lie.random_rotations(key_R, num, d, dtype)
    t = spread * jax.random.normal(key_t, (num, d), dtype)
    return lie.compose(R, t)


def gaussian(
    key: Key,
    num: int,
    init: Motion,
    translation_spread: Array | float,
    rotation_spread: Array | float,
) -> Float[Array, "p D D"]:
    """Poses around `init`, normal in each tangent coordinate; the first is `init`."""
    d = init.shape[-1] - 1
    k = lie.tangent_dim(d)
    spread = jnp.where(jnp.arange(k) < d, translation_spread, rotation_spread)
    tangent = spread * jax.random.normal(key, (num, k), init.dtype)
    return jax.vmap(turn_and_shift, (None, 0))(init, tangent.at[0].set(0))
