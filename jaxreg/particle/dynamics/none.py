"""No dynamics."""

from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Key
from jaxreg.particle.dynamics.base import AbstractDynamics
from jaxreg.particle.state import Particles


class NoDynamics(AbstractDynamics):
    """x_t = x_{t-1}: particles move by the local optimiser alone.

    The first of the PF paper's comparison (section 5.2.1): copies of a particle stay
    copies, and each ends in the local minimum that it started above.
    """

    @property
    def needs_path(self) -> bool:
        """No."""
        return False

    def __call__(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p D D"]:
        """The poses themselves."""
        return particles.T_target_source
