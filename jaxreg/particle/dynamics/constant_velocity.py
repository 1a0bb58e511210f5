"""Constant velocity."""

import jax
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Key
from jaxreg.local import turn_and_shift
from jaxreg.particle.dynamics.base import AbstractDynamics
from jaxreg.particle.state import Particles


class ConstantVelocity(AbstractDynamics):
    """x_t = exp(e_{t-1}) x_{t-1}: a particle repeats its last motion error (Eq. 6).

    The second of the PF paper's comparison (section 5.2.1). Deterministic.
    """

    @property
    def needs_path(self) -> bool:
        """No."""
        return False

    def __call__(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p D D"]:
        """The poses, moved on by their motion errors."""
        return jax.vmap(turn_and_shift)(
            particles.T_target_source, particles.motion_error
        )
