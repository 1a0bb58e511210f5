"""Refinement: pairs that overlap are measured again, from the poses of all.

The MCC paper's chain, pairs then averaging, closed into a loop: poses from the average
say which scans overlap and how they lie; from there the motion of each such pair is
measured by a local optimiser, also of pairs that the search did not find; and these are
averaged in turn. (One least-squares system over the points of all pairs was half as
accurate on real scans: it lets the largest overlaps decide, though the errors of a scan
are not noise but warps, which the median of many pairs evens out.)
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import cast_floats
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Motion, Scalar
from jaxreg.averaging import MCC, AbstractAverager, SpanningTree
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.geometry import lie
from jaxreg.local import GaussNewton, LocalOptimiser
from jaxreg.matching import Evidence, PlaneToPlane
from jaxreg.multiview.averaged_pairs import AveragedPairs
from jaxreg.multiview.choose_pairs import LIKELY
from jaxreg.multiview.follow_points import follow_points
from jaxreg.multiview.in_blocks import in_blocks
from jaxreg.multiview.pair_evidence import pair_evidence
from jaxreg.multiview.parts import part_sizes
from jaxreg.multiview.place import Placement, place
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import roughly
from jaxreg.robust import GemanMcClure


#: Poses that other pairs vouch for need less evidence of their own: odds of e^2.
VOUCHED = 2.0
# Kernel widths in sample spacings: first by the voxel tables, then by exact search.
_TABLE_WIDTHS = (1.4, 1.2, 1.0, 0.8, 0.7, 0.7)
_EXACT_WIDTHS = (0.7, 0.7, 0.5, 0.5, 0.35, 0.35, 0.35, 0.35)
#: Of the last step, and how many lead there from the poses of all.
WIDTH_END, NUM_STEPS = _EXACT_WIDTHS[-1], len(_EXACT_WIDTHS)


def refine(
    scans: PreparedScans,
    placement: Placement,
    averaging: AbstractAverager | None,
    least: Scalar,
    pairs: Int[Array, "p 2"],
) -> tuple[Placement, RelativeMotions, AveragedPairs]:
    """Poses from pairs of placed scans that overlap, measured anew.

    They have derivatives by the points of the scans: of the last round, which matches
    are held in.

    Args:
        scans: prepared scans.
        placement: poses of the centred frames, and which scans hang together.
        averaging: None for `MCC`.
        least: log evidence of the pairs that count.
        pairs: those that may overlap (`near_pairs`).

    Returns:
        The placement by these pairs, the pairs, and what each counted for. Scans that
        no pair holds any more keep their poses, but are alone.
    """
    # From the poses that there are: a tree of thousands of scans drifts, and where its
    # ends meet pairs would be given up that agree with the poses.
    starts = averaging is None
    averaging = wide_unless_given(averaging)
    moving, scans = scans, lax.stop_gradient(scans)

    def averaged(
        motions: RelativeMotions, before: Placement, log_odds: Array
    ) -> Placement:
        start = lax.stop_gradient(before.T_world_i) if starts else None
        told = averaging, least, scans.count, start, roughly(least), log_odds
        return place(motions, scans.num_scans, *told)

    motions, log_odds = measured(scans, placement, least, pairs, exact=False)
    placement = _updated(placement, averaged(motions, placement, log_odds))
    motions, log_odds = measured(scans, placement, least, pairs, exact=True)
    told = optimiser_of(motions.T_i_j), _last_width(moving, placement), least
    motions = follow_points(moving, motions, *told)
    average = averaged(motions, placement, log_odds)
    counted = AveragedPairs.of(motions, average, least)
    return _updated(placement, average), motions, counted


def wide_unless_given(averaging: AbstractAverager | None) -> AbstractAverager:
    """No outliers are left: the paper's wider kernel takes more pairs in."""
    if averaging is None:
        return MCC(initialiser=SpanningTree())
    return averaging


@kept_program
def _updated(before: Placement, after: Placement) -> Placement:
    """The later poses: each part where its first scan lay, scans alone as they were."""
    first, held = after.part, part_sizes(after.part) > 1
    T_before_after = before.T_world_i @ lie.inverse(after.T_world_i)
    T = T_before_after[first] @ after.T_world_i
    T = jnp.where(held[:, None, None], T, before.T_world_i)
    return eqx.tree_at(lambda p: (p.T_world_i, p.part), before, (T, first))


def measured(
    scans: PreparedScans,
    placement: Placement,
    least: Scalar,
    pairs: Int[Array, "p 2"],
    *,
    exact: bool,
) -> tuple[RelativeMotions, Float[Array, " p"]]:
    """Motions and overlaps of pairs near the present poses, and what speaks for these.

    Returns:
        Of pairs of a part, m = 1; and the log odds that each pair's surfaces coincide
        at the poses, which others vouch for. They are 0 where surfaces hardly meet: of
        noise alone some points are near each other by chance. All are 1 if not `exact`:
        poses that are a little off do not tell parts apart.
    """

    def run(block: Array) -> tuple[RelativeMotions, Array]:
        told = pair_evidence(scans, placement, block)
        return _measured(scans, placement, least, block, told, exact=exact)

    motions, log_odds = in_blocks(run, pairs, (scans, placement))
    return eqx.tree_at(lambda m: m.pairs, motions, pairs), log_odds


@kept_program
def _measured(
    scans: PreparedScans,
    placement: Placement,
    least: Scalar,
    pairs: Int[Array, "b 2"],
    told: Evidence,
    *,
    exact: bool,
) -> tuple[RelativeMotions, Float[Array, " b"]]:
    T_world_i = placement.T_world_i
    widths = widths_of(scans, placement, exact=exact)
    optimiser = optimiser_of(T_world_i)

    def measured(pair: Array, T_i_j: Motion) -> Motion:
        problem = scans.problem(pair[0], pair[1], exact=exact)
        return lie.straightened(optimiser.repeat(problem, T_i_j, widths))

    def one(of: tuple[Array, Scalar]) -> Motion:
        pair, log_evidence = of
        T_i_j = lie.between(T_world_i[pair[0]], T_world_i[pair[1]])
        return control.cond(
            log_evidence >= least, measured, lambda _, T: T, pair, T_i_j
        )

    T_i_j = map_side_by_side(one, (pairs, told.log_evidence), scans.num_rows)
    each = T_i_j, told.overlap, told.log_evidence, told.inlier_rmse
    log_odds = jnp.where(told.fitness >= LIKELY, told.log_evidence + VOUCHED, 0)
    log_odds = log_odds if exact else jnp.ones_like(log_odds)
    return RelativeMotions(pairs, *(x[:, None] for x in each)), log_odds


def optimiser_of(like: Array) -> LocalOptimiser:
    """What the steps are by, in the dtype of the poses."""
    optimiser = LocalOptimiser(PlaneToPlane(0.01), GemanMcClure(), GaussNewton())
    return cast_floats(optimiser, like.dtype)


@kept_program
def _last_width(scans: PreparedScans, placement: Placement) -> Scalar:
    return widths_of(scans, placement)[-1]


def widths_of(
    scans: PreparedScans, placement: Placement, *, exact: bool = True
) -> Float[Array, " s"]:
    """Kernel widths of the steps."""
    alone = part_sizes(placement.part) == 1
    spacing = jnp.max(jnp.where(alone, 0, scans.spacing))
    # Of no pair: under `vmap` also what is not chosen must be finite.
    spacing = jnp.where(spacing > 0, spacing, 1)
    factors = _EXACT_WIDTHS if exact else _TABLE_WIDTHS
    return spacing * jnp.asarray(factors, spacing.dtype)
