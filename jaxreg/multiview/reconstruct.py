"""`reconstruct`: many scans into one frame, without an initial guess.

    scans -> pairs -> particle filter -> motion averaging -> joint refinement

Every stage is one compiled function. Under `jit` the stages run as one program; called
with arrays, a thin loop around them divides the pairs into batches, runs two at a
time, and reports progress.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.checks import (
    as_float_array,
    check_key,
    check_mask,
    check_points,
    is_concrete,
)
from jaxreg._core.padding import rounded_up, stacked
from jaxreg._core.status import Status
from jaxreg._core.threads import map_in_threads
from jaxreg._core.typing import Key, Progress, StatusArray
from jaxreg.averaging import AbstractAverager
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.multiview.place import Placement, place
from jaxreg.multiview.refine import refine_jointly
from jaxreg.multiview.relative import RelativeMotions, all_pairs, relative_motions
from jaxreg.multiview.scans import PreparedScans, prepare_scans
from jaxreg.particle import ParticleFilter


_PAIRS_PER_BATCH = 4
_THREADS = 2


class ReconstructionSolution(eqx.Module):
    """One pose per scan, and every pair that was tried.

    Attributes:
        T_world_i: `(v, d+1, d+1)` maps scan i to the world, which is the frame of scan
            0, or of the first placed scan if scan 0 could not be placed. Identity for
            scans that are not placed.
        status: int32; CONVERGED if every scan is placed, else DISCONNECTED.
        scan_status: `(v,)` int32; CONVERGED, TOO_FEW_POINTS, or LOW_OVERLAP for scans
            that could not be placed.
        placed: `(v,)`.
        graph: every pair that was registered, `T_i_j` in the input's frames and unit,
            prior weight the overlap where it is trusted and else 0.
        overlap: `(e,)` lesser share of either scan that lies on the other.
        edge_weight: `(e,)` trust, 0 to 1: how well the pair's own motion agrees with
            the final poses, by a Gaussian of the displacement of the scan whose width
            is the sample spacing; 0 where the overlap is too small or a scan is not
            placed.
        inlier_rmse: `(e,)` distance of that share, in the unit of the input.
        num_dropped: `(v,)` rows that were not finite.
    """

    T_world_i: Float[Array, "v D D"]
    status: StatusArray
    scan_status: Int[Array, " v"]
    placed: Bool[Array, " v"]
    graph: PoseGraph
    overlap: Float[Array, " e"]
    edge_weight: Float[Array, " e"]
    inlier_rmse: Float[Array, " e"]
    num_dropped: Int[Array, " v"]

    def __repr__(self) -> str:
        """One line: status, scans placed, pairs trusted."""
        if not is_concrete(self.status) or self.status.ndim:
            return f"ReconstructionSolution(T_world_i {self.T_world_i.shape})"
        return (
            f"ReconstructionSolution({Status(int(self.status)).name}, "
            f"{int(jnp.sum(self.placed))} of {self.placed.size} scans placed, "
            f"{int(jnp.sum(self.edge_weight > 0.5))} of {self.overlap.size} pairs "
            "trusted)"
        )


def reconstruct(
    scans: object,
    *,
    key: Key,
    method: ParticleFilter | None = None,
    averaging: AbstractAverager | None = None,
    mask: object = None,
    progress: Progress | None = None,
) -> ReconstructionSolution:
    """Brings scans into one frame, without an initial guess.

    Args:
        scans: a list of `(n_i, d)` point sets, or a padded array `(v, n, d)`.
        key: a `jax.random.key`; the same key gives the same answer.
        method: the search between pairs, `ParticleFilter()` by default.
        averaging: how relative motions become poses; None for the MCC paper's
            `Correntropy` from the spanning tree of largest overlap.
        mask: `(v, n)` True for valid points, for a padded array only.
        progress: called as `progress(stage, done, total)`; not under `jit`.

    Returns:
        A `ReconstructionSolution`.

    Raises:
        ValueError, TypeError: while tracing, for shapes and types that do not fit.

    Fails:
        DISCONNECTED where some scans could not be placed; `scan_status` says which.

    Gradients:
        None; the search is cut.

    Reference:
        Sandhu, Dambreville, Tannenbaum for the pairs; Zhu et al. for the averaging.
    """
    points, row_mask = _padded(scans, mask)
    method = ParticleFilter() if method is None else method
    if not isinstance(method, ParticleFilter):
        raise TypeError(
            f"method: wanted a ParticleFilter, found {type(method).__name__}."
        )
    key = check_key(key)
    pairs = all_pairs(points.shape[0])
    if not (is_concrete(points) and is_concrete(key)):
        prepared = prepare_scans(method, points, row_mask)
        motions = relative_motions(method, prepared, pairs, key)
        return _finish(method, averaging, prepared, pairs, motions)

    report = progress if progress is not None else _silent
    report("preparing scans", 0, 1)
    prepared = jax.block_until_ready(prepare_scans(method, points, row_mask))
    report("preparing scans", 1, 1)
    motions = _motions_in_batches(method, prepared, pairs, key, report)
    report("averaging and refining", 0, 1)
    solution = _finish(method, averaging, prepared, pairs, motions)
    solution = jax.block_until_ready(solution)
    report("averaging and refining", 1, 1)
    return solution


def _silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


def _padded(scans: object, mask: object) -> tuple[Array, Array]:
    """Scans as `(v, n, d)` with a mask."""
    if isinstance(scans, Sequence):
        if mask is not None:
            raise ValueError("mask: only for a padded array, not for a list of scans.")
        arrays = [as_float_array(x, f"scans[{i}]") for i, x in enumerate(scans)]
        for i, x in enumerate(arrays):
            check_points(x, f"scans[{i}]")
            if x.ndim != 2 or x.shape[1] != arrays[0].shape[1]:
                raise ValueError(
                    f"scans[{i}]: wanted shape (n, {arrays[0].shape[-1]}) like "
                    f"scans[0], found {x.shape}."
                )
        if len(arrays) < 2:
            raise ValueError(f"scans: wanted two or more, found {len(arrays)}.")
        dtype = jnp.result_type(*arrays)
        lengths = np.array([len(x) for x in arrays])
        rows = rounded_up(max(lengths.tolist()))
        row_mask = jnp.asarray(np.arange(rows) < lengths[:, None])
        return stacked([x.astype(dtype) for x in arrays], rows), row_mask
    points = as_float_array(scans, "scans")
    check_points(points, "scans")
    if points.ndim != 3 or points.shape[0] < 2:
        raise ValueError(
            "scans: wanted a list of two or more (n, d) arrays or a padded array "
            f"(v, n, d), found shape {points.shape}."
        )
    return points, check_mask(mask, points.shape[:2], "mask")


def _motions_in_batches(
    method: ParticleFilter,
    prepared: PreparedScans,
    pairs: Int[Array, "e 2"],
    key: Key,
    report: Progress,
) -> RelativeMotions:
    """The pairs in batches of one compiled size, two batches at a time."""
    total = pairs.shape[0]

    def run(start: int) -> RelativeMotions:
        rows = np.minimum(np.arange(start, start + _PAIRS_PER_BATCH), total - 1)
        return jax.block_until_ready(
            relative_motions(method, prepared, pairs[rows], key)
        )

    starts = range(0, total, _PAIRS_PER_BATCH)
    report("registering pairs", 0, total)
    batches = []
    for batch in map_in_threads(run, starts, _THREADS):
        batches.append(batch)
        done = min(len(batches) * _PAIRS_PER_BATCH, total)
        report("registering pairs", done, total)
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:total], *batches)


@eqx.filter_jit
def _finish(
    method: ParticleFilter,
    averaging: AbstractAverager | None,
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    motions: RelativeMotions,
) -> ReconstructionSolution:
    """Averages, refines, and returns to the frames and unit of the input."""
    min_overlap = jnp.asarray(method.min_overlap, scans.radius.dtype)
    placement = place(motions, pairs, scans.num_scans, averaging, min_overlap)
    T_centred = refine_jointly(
        scans, placement.T_world_i, placement.placed, min_overlap / 2
    )
    i, j = pairs[:, 0], pairs[:, 1]
    weight = jnp.where(motions.overlap >= min_overlap, motions.overlap, 0)
    graph = PoseGraph(
        pairs,
        scans.to_input_frames(motions.T_i_j, i, j),
        weight,
        jnp.ones(pairs.shape[0], bool),
        None,
        scans.num_scans,
    )
    placed = placement.placed
    scan_status = jnp.where(placed, Status.CONVERGED, Status.LOW_OVERLAP)
    scan_status = jnp.where(scans.enough, scan_status, Status.TOO_FEW_POINTS)
    return ReconstructionSolution(
        T_world_i=_in_first_frame(scans, T_centred, placement),
        status=jnp.where(jnp.all(placed), Status.CONVERGED, Status.DISCONNECTED).astype(
            jnp.int32
        ),
        scan_status=scan_status.astype(jnp.int32),
        placed=placed,
        graph=graph,
        overlap=motions.overlap,
        edge_weight=_trust(scans, pairs, motions, T_centred, placed, weight),
        inlier_rmse=motions.inlier_rmse * scans.radius,
        num_dropped=scans.num_dropped,
    )


def _trust(
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    motions: RelativeMotions,
    T_world_i: Float[Array, "v D D"],
    placed: Bool[Array, " v"],
    weight: Float[Array, " e"],
) -> Float[Array, " e"]:
    """Agreement of the pairs' motions with the poses; the centred radius is one."""
    i, j = pairs[:, 0], pairs[:, 1]
    T_error = lie.inverse(T_world_i[i]) @ T_world_i[j] @ lie.inverse(motions.T_i_j)
    turn = lie.rotation_angle(lie.rotation(T_error))
    centre = lie.translation(lie.inverse(T_world_i[i]) @ T_world_i[j])
    shift = centre - lie.translation(motions.T_i_j)
    sq = turn**2 + jnp.sum(shift**2, axis=-1)
    spacing = jnp.maximum(scans.spacing[i], scans.spacing[j])
    trust = jnp.exp(-sq / (2 * jnp.maximum(spacing, 1e-6) ** 2))
    return jnp.where((weight > 0) & placed[i] & placed[j], trust, 0)


def _in_first_frame(
    scans: PreparedScans, T_centred: Array, placement: Placement
) -> Float[Array, "v D D"]:
    """Poses relative to the first placed scan, in the input's frames and unit."""
    first = jnp.argmax(placement.placed).astype(jnp.int32)
    ids = jnp.arange(scans.num_scans, dtype=jnp.int32)
    T_first_i = lie.inverse(T_centred[first]) @ T_centred
    T = scans.to_input_frames(T_first_i, jnp.full_like(ids, first), ids)
    eye = jnp.eye(T.shape[-1], dtype=T.dtype)
    keep = placement.placed & (ids != first)
    return jnp.where(keep[:, None, None], T, eye)
