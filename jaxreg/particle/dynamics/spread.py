"""Over what the expectation of Eq. 7 is taken: the paper leaves it open."""

import abc
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Key
from jaxreg.linear.small import eigh
from jaxreg.particle.state import Particles, moment_of


class AbstractSpread(BriefModule):
    """S = E[e e^T] of the motion errors e (PF paper, Eq. 6-8)."""

    described: ClassVar[str] = "a spread such as OwnSpread()"
    #: Whether `Particles.path` has to be kept.
    needs_path: ClassVar[bool] = False

    @abc.abstractmethod
    def draw(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p k"]:
        """A tangent of N(0, S) for each particle.

        Args:
            key: randomness.
            particles: of time - 1, resampled.
            time: t, the number of motion errors in `particles.path`.
        """


class OwnSpread(AbstractSpread):
    """S = e e^T of the particle: it diffuses along its own last motion."""

    def draw(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p k"]:
        """The motion error times a normal number."""
        error = particles.motion_error
        return jax.random.normal(key, (error.shape[0], 1), error.dtype) * error


class EnsembleSpread(AbstractSpread):
    """S = sum_i w_i e_i e_i^T over the particles as resampled, the same for all."""

    def draw(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p k"]:
        """Normal vectors times a root of S."""
        error = particles.motion_error
        S = moment_of(error, jnp.exp(particles.log_weight))
        return jax.random.normal(key, error.shape, error.dtype) @ _root(S).T


class MeasuredSpread(AbstractSpread):
    """S = the mean of e e^T over all particles measured, before resampling.

    Those that are about to be dropped have often moved farthest, so it is wider than
    `EnsembleSpread` and lives longer: particles leave local minima by it.
    """

    def draw(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p k"]:
        """Normal vectors times a root of S."""
        error, S = particles.motion_error, particles.error_moment
        if S is None:
            S = moment_of(error, jnp.exp(particles.log_weight))
        return jax.random.normal(key, error.shape, error.dtype) @ _root(S).T


class PathSpread(AbstractSpread):
    """S = the mean of e e^T over the particle's ancestors and itself."""

    needs_path: ClassVar[bool] = True

    def draw(
        self, key: Key, particles: Particles, time: Int[Array, ""]
    ) -> Float[Array, "p k"]:
        """A sum of the path's errors with independent factors: it has that S."""
        path = particles.path
        assert path is not None
        draws = jax.random.normal(key, path.shape[:2], path.dtype)
        sums = jnp.einsum("pt,ptk->pk", draws, path)
        return sums / jnp.sqrt(jnp.maximum(time, 1).astype(path.dtype))


def _root(S: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """L with L L^T = S; singular where the errors span less."""
    value, vector = eigh(S)
    return vector * jnp.sqrt(jnp.maximum(value, 0))[None]
