"""`jaxreg multiview`: many scans into one frame."""

import dataclasses
import hashlib
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor
from pathlib import Path
from typing import Any

import numpy as np

import jaxreg
from jaxreg._core.status import Status
from jaxreg._core.typing import Progress
from jaxreg.app.cli import outputs
from jaxreg.app.cli.cluster import executor_of
from jaxreg.app.cli.inputs import Scans, load_scans, read_positions
from jaxreg.app.cli.known import (
    NOTHING,
    is_told,
    known_of_scans,
    of_middles,
    read_known_scans,
    show_entries,
    with_names,
)
from jaxreg.app.cli.options import Multiview, Order
from jaxreg.app.cli.runtime import Session, key_of, method_of
from jaxreg.app.live import LiveView
from jaxreg.app.pair_log import PairLog, Pairs
from jaxreg.app.plot.results import MAX_COVARIANCES, result_of
from jaxreg.app.result import Result
from jaxreg.app.versions import version
from jaxreg.app.views import open_where_seen
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o_known import KnownOfGraph
from jaxreg.io.poses.stanford import read_conf
from jaxreg.multiview.workers import WorkerError


def run(command: Multiview, session: Session) -> int:
    """Runs the command; returns the exit code."""
    with session.timed("read"):
        if not command.scans:
            raise InputError("No scans given.\nUsage: jaxreg multiview SCAN SCAN ...")
        command.check_model()
        scans = load_scans(command.scans)
        command.check_known(scans.points[0].shape[1])
        scans.check_viewpoint(command.viewpoint)
        located = _located(command, scans)
        known = read_known_scans(command, scans.names, scans.points[0].shape[1])
        truth = None if command.truth is None else _read_truth(command.truth, scans)
    for note in scans.notes:
        session.console.print(note)
    key, method = key_of(command), method_of(command)
    log = _log(command, session, scans)
    view = _view(session, scans, method, log) if command.view else None
    try:
        with (
            executor_of(command.cluster) as executor,
            session.progress() as progress,
            session.timed("run", computes=True),
        ):
            result = reconstruct_scans(
                scans,
                key,
                method,
                progress if view is None else _both(progress, view.progress),
                command.order,
                log,
                command.viewpoint,
                located,
                known,
                None if view is None else view.pairs,
                executor,
            )
        if view is not None:
            view.poses(result.T_world_i, result.component, result.edges, result.weight)
    except KeyboardInterrupt as err:
        if not len(log):
            raise
        raise KeyboardInterrupt(_kept(log)) from err
    except BrokenExecutor as err:
        raise InputError(
            f"--cluster {command.cluster}: a process ended before its pairs were "
            f"registered, as for want of memory.\n{_kept(log)}"
        ) from err
    except WorkerError as err:
        raise InputError(f"--cluster {command.cluster}: {err}\n{_kept(log)}") from err
    finally:
        if view is not None:
            view.close()
    if result.known is not None:
        result = dataclasses.replace(result, known=with_names(result.known, command))
    errors = None if truth is None else outputs.pose_errors(result, *truth)
    code = report(session, result, scans, errors)
    log.remove()
    return code


def _kept(log: PairLog) -> str:
    return (
        f"pairs kept in {log.path}: {len(log)}; "
        "the same command with --resume goes on from there"
    )


def _view(
    session: Session, scans: Scans, method: jaxreg.ParticleFilter, log: PairLog
) -> LiveView:
    """The page, opened where there is a screen, with the pairs that are known."""
    least = float(np.asarray(method.min_log_evidence))
    view = LiveView(scans.names, *scans.centred(), least)
    session.console.print(f"To watch while it runs: {view.url}")
    open_where_seen(view.url)
    if log.pairs is not None:
        view.pairs(log.pairs)
    return view


def _both(one: Progress, other: Progress) -> Progress:
    def tell(stage: str, done: int, total: int) -> None:
        one(stage, done, total)
        other(stage, done, total)

    return tell


def _located(command: Multiview, scans: Scans) -> jaxreg.ScanPositions | None:
    """About where the scanners stood, for scans moved to their middles."""
    if command.positions is None:
        return None
    antenna = -scans.centred()[1]
    if command.viewpoint is not None:
        antenna = antenna + command.viewpoint
    return jaxreg.ScanPositions(
        read_positions(command.positions, scans), command.deviation, antenna
    )


def _log(command: Multiview, session: Session, scans: Scans) -> PairLog:
    digest = hashlib.sha256(repr(scans.names).encode())
    for points in scans.points:
        digest.update(np.ascontiguousarray(points).tobytes())
    run = {
        "scans": digest.hexdigest(),
        "seed": command.seed,
        "viewpoint": command.viewpoint,
        "upright": command.upright,
        "positions": None
        if command.positions is None
        else [command.deviation, read_positions(command.positions, scans).tolist()],
        "budget": command.budget,
        "precision": command.precision,
        "version": version("jaxreg"),
    }
    log = PairLog(
        command.out / "pairs.jsonl",
        run,
        resume=command.resume,
        num_scans=len(scans.names),
        dim=scans.points[0].shape[1],
    )
    if log.damage is not None:
        session.console.print(f"{log.path}: {log.damage}.")
    if not command.resume and log.path.exists():
        session.console.print(
            f"{log.path}: pairs of an interrupted run, replaced by those of this "
            "one; --resume would go on with them."
        )
    elif command.resume and not len(log):
        session.console.print(f"{log.path}: no pairs to go on with, all are new.")
    return log


def reconstruct_scans(
    scans: Scans,
    key: Any,
    method: jaxreg.ParticleFilter,
    progress: Progress,
    order: Order = "any",
    log: PairLog | None = None,
    viewpoint: tuple[float, ...] | None = None,
    positions: jaxreg.ScanPositions | None = None,
    known: KnownOfGraph | None = None,
    heard: Callable[[Pairs], None] | None = None,
    executor: Executor | None = None,
) -> Result:
    """Reconstructs centred scans and moves the answer to the frames of the files.

    Pairs that `log` holds are not registered again, and those found are added to it;
    `heard` is told of them, too.
    """
    centred, middles = scans.centred()
    eyes = None if viewpoint is None else (viewpoint - middles).astype(centred[0].dtype)
    known = NOTHING if known is None else known
    told = of_middles(known, middles)
    kept = None if log is None or log.pairs is None else log.pairs

    def keep(motions: jaxreg.RelativeMotions) -> None:
        found = _pairs(motions)
        for tell in (heard, None if log is None else log.add):
            if tell is not None:
                tell(found)

    sol = jaxreg.reconstruct(
        centred,
        key=key,
        method=method,
        order=order,
        viewpoints=eyes,
        positions=positions,
        fixed=told.fixed,
        control=told.control,
        levels=told.levels,
        previous=None if kept is None else jaxreg.RelativeMotions.kept(*kept),
        progress=progress,
        on_pairs=keep,
        executor=executor,
    )
    result = result_of(sol, scans.points, scans.names)
    result = dataclasses.replace(result, covariances=_covariances(centred, sol))
    # The frame of a component's first scan; that of a scan alone means nothing.
    _, first, row = np.unique(result.component, return_index=True, return_inverse=True)
    first = first[row]
    there, i, j = middles[first], *result.edges.T
    in_world = is_told(known) and result.status != Status.DEGENERATE
    if in_world:
        there = np.where((result.component == 0)[:, None], 0, there)
    T_world_i = outputs.uncentre(result.T_world_i, there, middles)
    result = dataclasses.replace(
        result,
        T_world_i=T_world_i,
        T_i_j=outputs.uncentre(result.T_i_j, middles[i], middles[j]),
    )
    if not in_world:
        return result
    entries = known_of_scans(known, result, sol.prior_weight)
    held = tuple(result.names[frame] for frame, _ in known.fixed)
    return dataclasses.replace(result, fixed=held, known=entries)


def _covariances(
    scans: list[np.ndarray], sol: jaxreg.ReconstructionSolution
) -> np.ndarray | None:
    """Relative to the first scan of each component; None of too many scans."""
    component = np.asarray(sol.component)
    if len(scans) > MAX_COVARIANCES or not (component == 0).any():
        return None
    firsts = [int(np.argmax(component == c)) for c in range(int(component.max()) + 1)]
    each = [
        np.asarray(jaxreg.scan_covariances(scans, sol, relative_to=first), np.float64)
        for first in firsts
    ]
    out = np.full_like(each[0], np.nan)
    for c, found in enumerate(each):
        out[component == c] = found[component == c]
    return out


def _pairs(motions: Any) -> Pairs:
    return Pairs(
        *map(
            np.asarray,
            (
                motions.pairs,
                motions.T_i_j,
                motions.overlap,
                motions.log_evidence,
                motions.inlier_rmse,
            ),
        )
    )


def report(
    session: Session, result: Result, scans: Scans, errors: dict[str, Any] | None
) -> int:
    """Writes the files and prints the tables; returns the exit code."""
    result = outputs.write_files(session, result, scans.points, errors, read=scans)
    outputs.show_scans(session, result)
    show_entries(session, result.known or [])
    if not result.believed:
        return _tell_none_joined(session, result, scans)
    if errors is not None:
        outputs.show_errors(session, errors)
    outputs.show_end(session, result.files, session.options.out)
    return 0


def _tell_none_joined(session: Session, result: Result, scans: Scans) -> int:
    places = scans.places
    who = (
        " and ".join(places)
        if len(places) == 2
        else f"{places[0]} and {len(places) - 1} more"
    )
    status = (
        result.status if result.status != Status.DISCONNECTED else Status.LOW_OVERLAP
    )
    what = f"{who}: no two scans could be joined"
    return outputs.tell_failure(session, result, what, status)


def _read_truth(path: Path, scans: Scans) -> tuple[list[str], np.ndarray]:
    poses = read_conf(path)
    if scans.points[0].shape[1] != 3:
        raise InputError(f"{path}: holds 3D poses, but the scans are 2D.")
    common = [name for name in scans.names if name in poses]
    if len(common) < 2:
        raise InputError(
            f"{path}: holds poses of {', '.join(list(poses)[:3])}, ... but the scans "
            f"are {', '.join(scans.names[:3])}, ...\nGive the pose file of these scans."
        )
    return common, np.stack([poses[name] for name in common])
