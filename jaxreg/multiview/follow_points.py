"""Derivatives of relative motions by the points of both scans.

The last motions that are averaged are where the pulls of matched points balance; they
are differentiated through that, and the poses through the averaging of the motions.
"""

import equinox as eqx
import jax
from jax import lax
from jaxtyping import Array

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Motion, Scalar
from jaxreg.local import LocalOptimiser, Rest, at_rest
from jaxreg.matching import Problem
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.neighbours import exact_index


@kept_program
def follow_points(
    scans: PreparedScans,
    motions: RelativeMotions,
    optimiser: LocalOptimiser,
    width: Scalar,
    least: Scalar,
) -> RelativeMotions:
    """The same motions, m = 1, with derivatives by the points of the scans.

    Nothing is computed for these until they are asked for, and then one pair at a time.

    Args:
        scans: prepared scans, with the derivatives that are to be followed.
        motions: of pairs, where `optimiser` came to rest.
        optimiser: what came to rest.
        width: of its kernel in the last steps, with its derivatives.
        least: log evidence of the pairs that were measured; others stay.
    """

    def measured(pair: Array, T_i_j: Motion) -> Motion:
        source, target = scans.cloud(pair[1]), scans.cloud(pair[0])
        held, mask = lax.stop_gradient(target.points), target.mask
        index = exact_index(len(mask)).build(held, mask)
        problem = Problem.of(source, target, index)
        rest = Rest(optimiser=optimiser, problem=problem, width=width, T=T_i_j)
        return at_rest(rest)[0]

    # What one pair needs is computed again on the way back, not kept for all.
    measured = jax.checkpoint(measured)

    def one(of: tuple[Array, Motion, Scalar]) -> Motion:
        pair, T_i_j, told = of
        return control.cond(told >= least, measured, lambda _, T: T, pair, T_i_j)

    of = motions.pairs, motions.T_i_j[:, 0], motions.log_evidence[:, 0]
    T_i_j = lax.map(one, of)
    return eqx.tree_at(lambda m: m.T_i_j, motions, T_i_j[:, None])
