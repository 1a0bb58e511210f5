"""From the motions of pairs to the answer: poses, statuses, trust."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.averaging import AbstractAverager
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.multiview.averaged_pairs import AveragedPairs
from jaxreg.multiview.find_slipping import slipping
from jaxreg.multiview.find_turnable import turnable
from jaxreg.multiview.hold_poses import Held
from jaxreg.multiview.known_world import KnownWorld
from jaxreg.multiview.likely_overlap import LikelyOverlap
from jaxreg.multiview.method import min_log_evidence
from jaxreg.multiview.near_pairs import near_pairs
from jaxreg.multiview.pair_trust import pair_trust
from jaxreg.multiview.place import Placement, agreeing, place
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import VOUCHED, refine
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.multiview.which_join import prior_weight, roughly
from jaxreg.registrar import AbstractRegistrar


def finish(
    method: AbstractRegistrar,
    averaging: AbstractAverager | None,
    scans: PreparedScans,
    motions: RelativeMotions,
    hold: Held | None = None,
    known: KnownWorld | None = None,
    overlaps: LikelyOverlap | None = None,
) -> ReconstructionSolution:
    """Averages, refines, and returns to the frames and unit of the input.

    Args:
        method: tells which pairs are trusted.
        averaging: see `place`.
        scans: prepared scans.
        motions: of pairs, in the scans' centred frames; some may be padding.
        hold: old frames that stay, or None.
        known: what is known of the world, less its origin, or None.
        overlaps: what is known of them; None under `jit`.
    """
    moving, scans = scans, lax.stop_gradient(scans)
    least = jnp.asarray(min_log_evidence(method), scans.radius.dtype)
    if hold is None:
        told = averaging, least, scans.count, None, roughly(least)
        placement = place(motions, scans.num_scans, *told)
    else:
        told = averaging, least, roughly(least)
        placement = hold.place(scans, motions, *told)
    mode, turns = placement.mode, turnable(motions, placement)
    pairs = near_pairs(scans, placement, motions, overlaps)
    likely = least - VOUCHED
    if hold is not None:
        pairs = hold.of_new(pairs)
        placement, averaged = hold.refine(scans, placement, averaging, likely, pairs)
        free = turns | slipping(scans, placement, least, pairs, hold.held)
        free = free & ~hold.held
        told = placement, averaged, free, least
        solution = _solution(scans, motions, mode, *told)
        return hold.in_world(solution)
    refined = refine(moving, placement, averaging, likely, pairs)
    placement, measured, averaged = refined
    free = turns | slipping(scans, placement, least, pairs)
    if known is None:
        return _solution(moving, motions, mode, placement, averaged, free, least)
    placement, trust = known.place(scans, placement, measured, averaging, likely)
    free = free & ~known.fixed
    solution = _solution(moving, motions, mode, placement, averaged, free, least)
    return eqx.tree_at(
        lambda s: s.prior_weight, solution, trust, is_leaf=lambda x: x is None
    )


@kept_program
def _solution(
    scans: PreparedScans,
    motions: RelativeMotions,
    mode: Int[Array, " e"],
    placement: Placement,
    averaged: AveragedPairs,
    free: Bool[Array, " v"],
    least: Scalar,
) -> ReconstructionSolution:
    """In the frames and unit of the input."""
    found = motions.in_input_frames(scans)
    _, agrees = agreeing(motions, placement, least)
    one = found.of_modes(mode, agrees)
    overlap, T_i_j = one.overlap[:, 0], one.T_i_j[:, 0]
    weight = prior_weight(one, least)
    real = motions.pairs[:, 0] != motions.pairs[:, 1]
    graph = PoseGraph(found.pairs, T_i_j, weight, real, None, scans.num_scans)
    component, placed = placement.component, placement.placed
    scan_status = jnp.where(component < 0, Status.LOW_OVERLAP, Status.DISCONNECTED)
    agreed = placement.status != Status.NO_AGREEMENT
    found_status = jnp.where(agreed, Status.CONVERGED, Status.NO_AGREEMENT)
    scan_status = jnp.where(placed, found_status, scan_status)
    scan_status = jnp.where(free & (component >= 0), Status.AMBIGUOUS, scan_status)
    scan_status = jnp.where(placement.misfit, Status.NO_AGREEMENT, scan_status)
    scan_status = jnp.where(scans.usable, scan_status, scans.fault)
    status = jnp.where(jnp.any(free & placed), Status.AMBIGUOUS, found_status)
    every = jnp.all(placed | ~scans.present)
    status = jnp.where(every, status, Status.DISCONNECTED)
    unheld = placement.status == Status.DEGENERATE
    status = jnp.where(unheld, Status.DEGENERATE, status)
    trace = placement.trace
    return ReconstructionSolution(
        T_world_i=_in_first_frames(scans, placement),
        status=status.astype(jnp.int32),
        scan_status=scan_status.astype(jnp.int32),
        placed=placed,
        component=component,
        graph=graph,
        overlap=overlap,
        edge_weight=pair_trust(scans, motions.of_modes(mode), placement, weight),
        inlier_rmse=one.inlier_rmse[:, 0],
        mode=mode,
        motions=found,
        averaged=averaged,
        num_dropped=scans.num_dropped,
        trace=None if trace is None else trace.in_unit(scans.radius),
    )


def _in_first_frames(
    scans: PreparedScans, placement: Placement
) -> Float[Array, "v D D"]:
    """Poses in the frame of each part's first scan, or in the world that is known.

    In the input's frames and unit.
    """
    first = placement.part
    ids = jnp.arange(scans.num_scans, dtype=jnp.int32)
    T_first_i = lie.between(placement.T_world_i[first], placement.T_world_i)
    T = scans.to_input_frames(T_first_i, first, ids)
    eye = jnp.eye(T.shape[-1], dtype=T.dtype)
    T = jnp.where((ids != first)[:, None, None], T, eye[None])
    in_world = scans.to_world(placement.T_world_i)
    return jnp.where((first == placement.world)[:, None, None], in_world, T)
