"""Poses that may be the answer: distinct ones of the particles, and proposed ones."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Motion, Scalar
from jaxreg.particle.modes import distinct_modes
from jaxreg.particle.state import Particles
from jaxreg.registrar import SearchTrace


#: Poses nearer than this, in radians and radii, are one mode.
APART = 0.3
# What is known beforehand may outweigh all evidence: no pose has more.
_MOST_EVIDENCE = 10.0

#: What is known of a pose beforehand, in the frames of the search.
LogPrior = Callable[[Motion], Scalar]


class Found(eqx.Module):
    """What a search ended with.

    Attributes:
        particles: measured poses, with energies and weights.
        num_steps: int32, steps of the local optimiser along the path of one of them.
        finished: whether they had come to rest.
        sure: whether there is no need to look for other poses.
        trace: of the steps of a filter.
    """

    particles: Particles
    num_steps: Int[Array, ""]
    finished: Bool[Array, ""]
    sure: Bool[Array, ""]
    trace: SearchTrace | None = None


class Candidates(eqx.Module):
    """Poses to be refined and judged, and how they were found.

    Attributes:
        T: the poses.
        mass: shares of the particles, then 1 for each proposal; 0 where there is none.
        num_steps, finished, trace: as in `Found`.
    """

    T: Float[Array, "q D D"]
    mass: Float[Array, " q"]
    num_steps: Int[Array, ""]
    finished: Bool[Array, ""]
    trace: SearchTrace | None

    @classmethod
    def of(
        cls,
        found: Found,
        num_modes: int,
        proposals: tuple[Float[Array, "r D D"], Bool[Array, " r"]] | None = None,
        log_prior: LogPrior | None = None,
    ) -> "Candidates":
        """Of a search.

        Args:
            found: by the search.
            num_modes: how many distinct poses of the particles.
            proposals: more poses, and which of them are in use.
            log_prior: of a pose; hopeless ones come last.
        """
        particles = found.particles
        limit, last = jnp.asarray(APART, particles.energy.dtype), None
        if log_prior is not None:
            last = jax.vmap(log_prior)(particles.T_target_source) < -_MOST_EVIDENCE
        how = particles, num_modes, last
        rows, mass = distinct_modes(*how, angle=limit, distance=limit)
        T = particles.T_target_source[rows]
        if proposals is not None:
            T = jnp.concatenate([T, proposals[0]])
            mass = jnp.concatenate([mass, proposals[1].astype(mass.dtype)])
        return cls(T, mass, found.num_steps, found.finished, found.trace)
