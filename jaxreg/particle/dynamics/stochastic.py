"""Stochastic dynamics: diffusion along the motion error."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.linear.small import eigh
from jaxreg.local import turn_and_shift
from jaxreg.particle.dynamics.base import AbstractDynamics
from jaxreg.particle.state import Particles


_SPREADS = ("own", "ensemble", "path")


class StochasticDynamics(AbstractDynamics):
    """x_t ~ N(x_{t-1}, scale^2 S), S = E[e e^T] (PF paper, Eq. 6-8).

    e is the motion error, what the local optimiser moved a particle by, so the
    diffusion dies as the optimiser converges. Over what the expectation is taken the
    paper leaves open:

        own         S = e e^T of the particle: it diffuses along its own last motion
        ensemble    S = sum_i w_i e_i e_i^T over the particles, the same for all
        path        S = mean of e e^T over the particle's ancestors and itself

    Attributes:
        scale: alpha of Eq. 8, one in the paper.
        spread: static; "own", "ensemble" or "path".

    Raises: ValueError for another spread.
    """

    scale: Array | float = traced(1.0)
    spread: Literal["own", "ensemble", "path"] = eqx.field(default="own", static=True)

    def __check_init__(self) -> None:
        """Refuses an unknown spread."""
        if self.spread not in _SPREADS:
            raise ValueError(
                f"StochasticDynamics: spread must be one of {_SPREADS}, found "
                f"{self.spread!r}."
            )

    @property
    def needs_path(self) -> bool:
        """For the mean over the path."""
        return self.spread == "path"

    def __call__(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p D D"]:
        """The poses, moved by a draw each."""
        error = particles.motion_error
        if self.spread == "own":
            xi = jax.random.normal(key, (error.shape[0], 1), error.dtype) * error
        elif self.spread == "ensemble":
            root = _root_of_covariance(error, jnp.exp(particles.log_weight))
            xi = jax.random.normal(key, error.shape, error.dtype) @ root.T
        else:
            assert particles.path is not None
            # A sum of errors with independent factors has the sum of their e e^T.
            draws = jax.random.normal(key, particles.path.shape[:2], error.dtype)
            xi = jnp.einsum("pt,ptk->pk", draws, particles.path)
            xi = xi / jnp.sqrt(jnp.maximum(time, 1).astype(error.dtype))
        return jax.vmap(turn_and_shift)(particles.T_target_source, self.scale * xi)


def _root_of_covariance(
    error: Float[Array, "p k"], weight: Float[Array, " p"]
) -> Float[Array, "k k"]:
    """L with L L^T = sum_i w_i e_i e_i^T; singular where the errors span less."""
    # Rows out of use have no weight, but may hold errors that are not finite.
    error = jnp.where((weight > 0)[:, None] & jnp.isfinite(error), error, 0)
    S = jnp.einsum("p,pi,pj->ij", weight, error, error)
    value, vector = eigh(S)
    return vector * jnp.sqrt(jnp.maximum(value, 0))
