"""Which pairs of placed scans are worth another look: of a few scans all of them.

Of many scans the pairs that placed them, and each scan with a few that overlap it:
a number that grows with the scans and not with their square.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.matching import Match, Problem, match
from jaxreg.multiview.choose_pairs import ALL_UP_TO, LIKELY
from jaxreg.multiview.place import Placement, joins
from jaxreg.multiview.prepare import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions


# Partners of a scan beside those that placed it, drawn among those that overlap it: the
# nearest tell less, as chains of them drift.
_PARTNERS = 16
# Poses of a chain drift: points this many spacings apart, one spacing over or under the
# other's plane, may still be of one place.
_DRIFT = 6.0
# Points of a scan that tell what share of it another saw, to 0.02.
_POINTS = 512


@kept_program
def near_pairs(
    scans: PreparedScans, placement: Placement, motions: RelativeMotions
) -> Int[Array, "p 2"]:
    """Scans i <= j; the pairs of a scan and itself are padding.

    Args:
        scans: prepared scans.
        placement: their poses, by the motions.
        motions: those that were averaged.
    """
    num = scans.num_scans
    if num <= ALL_UP_TO:
        return jnp.stack(jnp.triu_indices(num, 1), axis=1)
    overlap = likely_overlap(scans, placement)
    draw = jax.random.uniform(jax.random.key(0), overlap.shape, overlap.dtype)
    draw = jnp.triu(jnp.where(overlap >= LIKELY, draw, 0), 1)
    draw = draw + draw.T
    least = jnp.sort(draw, axis=1)[:, -_PARTNERS]
    chosen = (draw >= least[:, None]) & (draw > 0)
    i, j = motions.pairs.T
    chosen = chosen.at[i, j].max(joins(placement.edge_weight))
    chosen = jnp.triu(chosen | chosen.T, 1)
    size = min(len(motions.pairs) + _PARTNERS * num, num * (num - 1) // 2)
    pairs = jnp.nonzero(chosen, size=size, fill_value=0)
    return jnp.stack(pairs, axis=1).astype(jnp.int32)


def likely_overlap(scans: PreparedScans, placement: Placement) -> Float[Array, "v v"]:
    """The share of scan j that is near scan i by the poses, i < j; else zero."""
    T = placement.T_world_i

    def share(pair: Array) -> Array:
        i, j = pair
        problem = Problem.of(scans.cloud(j), scans.cloud(i), scans.table(i))
        problem = problem.every(-(-problem.source.shape[1] // _POINTS))
        return control.cond(
            placement.together(i, j),
            lambda: _near(match(problem, lie.between(T[i], T[j])), scans.coarsest),
            lambda: jnp.zeros_like(scans.coarsest),
        )

    i, j = jnp.triu_indices(scans.num_scans, 1)
    shares = lax.map(share, jnp.stack([i, j], axis=1))
    return jnp.zeros((scans.num_scans,) * 2, T.dtype).at[i, j].set(shares)


def _near(found: Match, spacing: Scalar) -> Scalar:
    """The share of the points that may be of the other surface."""
    flat = jnp.any(found.normal != 0, axis=0)
    near = (found.sq_residual < (_DRIFT * spacing) ** 2) & found.mask
    near = near & (~flat | (jnp.abs(found.plane_residual) < spacing))
    share = jnp.sum(near) / jnp.maximum(jnp.sum(found.mask), 1)
    return share.astype(spacing.dtype)
