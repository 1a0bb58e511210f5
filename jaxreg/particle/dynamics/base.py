"""The contract of dynamics."""

import abc
from typing import ClassVar

from jaxtyping import Array, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Key
from jaxreg.particle.state import Particles


class AbstractDynamics(BriefModule):
    """The prediction p(x_t | x_{t-1}, z_{t-1}) (PF paper, section 3.2)."""

    described: ClassVar[str] = "dynamics such as StochasticDynamics()"

    @property
    @abc.abstractmethod
    def needs_path(self) -> bool:
        """Whether `Particles.path` has to be kept."""

    @abc.abstractmethod
    def __call__(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p D D"]:
        """Predicted poses; those of the particles where the motion errors are zero.

        Args:
            key: randomness.
            particles: of time - 1, resampled.
            time: t, the number of motion errors in `particles.path`.
        """
