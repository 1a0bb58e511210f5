"""Relative motions between pairs of scans: batches of the pairwise search."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Key
from jaxreg.multiview.scans import PreparedScans
from jaxreg.particle import ParticleFilter


class RelativeMotions(eqx.Module):
    """What the search found for each pair, in the scans' centred frames.

    Attributes:
        T_i_j: `(e, d+1, d+1)`.
        overlap: `(e,)` see `RegistrationSolution`.
        inlier_rmse: `(e,)` in units of the common radius.
        status: `(e,)` int32.
    """

    T_i_j: Float[Array, "*e D D"]
    overlap: Float[Array, "*e"]
    inlier_rmse: Float[Array, "*e"]
    status: Int[Array, "*e"]


def all_pairs(num_scans: int) -> Int[Array, "e 2"]:
    """Every pair i < j once."""
    i, j = jnp.triu_indices(num_scans, 1)
    return jnp.stack([i, j], axis=1).astype(jnp.int32)


@eqx.filter_jit
def relative_motions(
    method: ParticleFilter,
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    key: Key,
) -> RelativeMotions:
    """Registers scan j to scan i for each pair (i, j), one pair after another.

    The random numbers of a pair depend on its ids alone, not on its place in the
    batch, so any division of the pairs into batches gives the same answer.
    """

    def one(pair: Array) -> RelativeMotions:
        i, j = pair
        pair_key = jax.random.fold_in(key, i * scans.num_scans + j)
        solution = method.solve_indexed(
            scans.cloud(j),
            scans.cloud(i),
            scans.table(j),
            scans.table(i),
            None,
            pair_key,
        )
        usable = scans.enough[i] & scans.enough[j]
        return RelativeMotions(
            solution.T_target_source,
            jnp.where(usable, solution.overlap, 0),
            solution.inlier_rmse,
            solution.status,
        )

    return lax.map(one, pairs)
