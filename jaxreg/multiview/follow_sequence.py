"""Pairs of a sequence: the motion goes on as before, or else it is searched for.

A scanner that moves on moves much as it did a scan ago, so a descent from that motion
finds most pairs of a sequence in a fraction of a search. What it finds is trusted at
once only if it is as likely as no chance is; else it competes with the search.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import cast_floats
from jaxreg._core.programs import kept_program
from jaxreg.geometry import lie
from jaxreg.local import GaussNewton, LocalOptimiser
from jaxreg.matching import NO_EVIDENCE, PlaneToPlane
from jaxreg.multiview.method import follower, log_prior
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.registrar import AbstractRegistrar


#: Log evidence from which no search competes with a motion: of 140 pairs of scans that
#: do not overlap none had as much.
SURE = 4.0
# Steps from the first kernel width of the search to the sample spacing, and there in
# the metric of both surfaces.
_STEPS, _POLISH = 24, 8


@kept_program
def descended(
    method: AbstractRegistrar,
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    T_i_j: Float[Array, "e D D"],
) -> RelativeMotions:
    """Motions by descents from guesses, in the scans' centred frames, m = 1.

    Pairs by the rows of the scans.
    """
    dtype = T_i_j.dtype
    coarse, widest = follower(method)
    fine = LocalOptimiser(PlaneToPlane(0.01), coarse.kernel, GaussNewton())
    coarse, fine = cast_floats((coarse, fine), dtype)

    def one(row: tuple[Array, Array]) -> RelativeMotions:
        (i, j), T = row
        problem = scans.problem(i, j)
        spacing = jnp.maximum(scans.spacing[i], scans.spacing[j])
        widths = jnp.geomspace(widest, 0.5 * spacing, _STEPS).astype(dtype)
        T = lie.straightened(coarse.repeat(problem, T, widths))
        evidence = scans.witness(i, j).of_pose(T)
        told = evidence.log_evidence + log_prior(scans.method_of(method, i, j), T)
        T = fine.repeat(problem, T, jnp.full(_POLISH, 0.5 * spacing, dtype))
        sound = scans.usable[i] & scans.usable[j] & jnp.all(jnp.isfinite(T))
        return RelativeMotions(
            scans.ids[row[0]],
            jnp.where(sound, lie.straightened(T), jnp.eye(len(T), dtype=dtype))[None],
            jnp.where(sound, evidence.overlap, 0)[None],
            jnp.where(sound, told, NO_EVIDENCE)[None],
            evidence.inlier_rmse[None],
        )

    return lax.map(one, (pairs, T_i_j))


def descended_in_input_frames(
    method: AbstractRegistrar,
    scans: PreparedScans,
    pair: tuple[int, int],
    T_i_j: np.ndarray,
) -> RelativeMotions:
    """One pair, by a descent from a guess in the input's frames and unit."""
    some, rows = scans.of_pairs(np.array([pair], np.int32))
    guess = jnp.asarray(T_i_j, scans.mean.dtype)[None]
    guess = some.to_centred_frames(guess, rows[:, 0], rows[:, 1])
    return descended(method, some, rows, guess)
