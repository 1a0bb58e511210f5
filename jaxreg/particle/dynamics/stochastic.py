"""Stochastic dynamics: diffusion along the motion error."""

import jax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative, check_parts
from jaxreg._core.typing import Key
from jaxreg.local import turn_and_shift
from jaxreg.particle.dynamics.base import AbstractDynamics
from jaxreg.particle.dynamics.spread import AbstractSpread, OwnSpread
from jaxreg.particle.state import Particles


class StochasticDynamics(AbstractDynamics):
    """x_t ~ N(x_{t-1}, scale^2 S), S = E[e e^T] (PF paper, Eq. 6-8).

    e is the motion error, what the local optimiser moved a particle by, so the
    diffusion dies as the optimiser converges.

    Attributes:
        scale: alpha of Eq. 8, one in the paper.
        spread: over what the expectation is taken, which the paper leaves open:
            `OwnSpread()`, `PathSpread()`, `EnsembleSpread()` or
            `MeasuredSpread()`.
    """

    scale: Array | float = traced(1.0)
    spread: AbstractSpread = OwnSpread()

    def __check_init__(self) -> None:
        """Refuses a negative scale, and what is no spread."""
        check_not_negative(self, "scale")
        check_parts(self, spread=AbstractSpread)

    @property
    def needs_path(self) -> bool:
        """For the mean over the path."""
        return self.spread.needs_path

    def __call__(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p D D"]:
        """The poses, moved by a draw each."""
        xi = self.spread.draw(key, particles, time)
        return jax.vmap(turn_and_shift)(particles.T_target_source, self.scale * xi)
