"""Stochastic dynamics: particles diffuse along their motion error (Eq. 6-8)."""

import jax
from jaxtyping import Array, Float

from jaxreg._core.typing import Key
from jaxreg.local import turn_and_shift
from jaxreg.particle.state import Particles


def diffuse(
    key: Key, particles: Particles, scale: Array | float
) -> Float[Array, "p D D"]:
    """Predicted poses: each particle moves along its own motion error e.

    The covariance of Eq. 7 is read per particle, S = e e^T, so the proposal of Eq. 8,
    N(x, scale^2 S), is a normal number times e. It dies as the optimiser converges.
    """
    error = particles.motion_error
    xi = scale * jax.random.normal(key, (error.shape[0], 1), error.dtype)
    return jax.vmap(turn_and_shift)(particles.T_target_source, xi * error)
