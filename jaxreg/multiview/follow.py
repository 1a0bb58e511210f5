"""Pairs of a sequence: the motion goes on as before, or else it is searched for.

A scanner that moves on moves much as it did a scan ago, so a descent from that motion
finds most pairs of a sequence in a fraction of a search. What it finds is believed at
once only if it overlaps by so much as no chance does; else it competes with the search.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import cast_floats
from jaxreg._core.compile import compiled
from jaxreg.local import LocalOptimiser, Problem
from jaxreg.multiview.relative import RelativeMotions
from jaxreg.multiview.scans import PreparedScans
from jaxreg.particle import ParticleFilter, Particles
from jaxreg.particle.conclude import Pair, conclude


#: Overlap from which no search competes with a motion.
SURE = 0.5
# Steps from the first kernel width of the search to the last one's scale.
_STEPS = 12


@compiled
def descended(
    method: ParticleFilter,
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    T_i_j: Float[Array, "e D D"],
) -> RelativeMotions:
    """Motions by descents from guesses, in the scans' centred frames."""

    def one(row: tuple[Array, Array]) -> RelativeMotions:
        (i, j), T = row
        source, target = scans.cloud(j), scans.cloud(i)
        pair = Pair(source, target, scans.table(j), scans.table(i))
        optimiser = LocalOptimiser(method.residual, method.kernel, method.step)
        optimiser = cast_floats(optimiser, T.dtype)
        widths = jnp.geomspace(method.width_start, method.width_end, _STEPS)
        problem = Problem.of(source, target, scans.table(i))
        T = optimiser.repeat(problem, T, widths.astype(T.dtype))
        particles = Particles.at(T[None], 1)
        particles = eqx.tree_at(lambda p: p.energy, particles, jnp.zeros_like(T[0, :1]))
        found = conclude(
            pair,
            particles,
            jnp.asarray(_STEPS, jnp.int32),
            jnp.asarray(True),
            kernel=cast_floats(method.kernel, T.dtype),
            num_modes=1,
            refine_steps=method.refine_steps,
            min_overlap=method.min_overlap,
        )
        usable = scans.enough[i] & scans.enough[j]
        return RelativeMotions(
            row[0],
            found.T_target_source,
            jnp.where(usable, found.overlap, 0),
            found.inlier_rmse,
        )

    return lax.map(one, (pairs, T_i_j))


def descended_in_input_frames(
    method: ParticleFilter,
    scans: PreparedScans,
    pair: tuple[int, int],
    T_i_j: np.ndarray,
) -> RelativeMotions:
    """One pair, by a descent from a guess in the input's frames and unit."""
    pairs = jnp.array([pair], jnp.int32)
    guess = jnp.asarray(T_i_j, scans.mean.dtype)[None]
    guess = scans.to_centred_frames(guess, pairs[:, 0], pairs[:, 1])
    return descended(method, scans, pairs, guess)
