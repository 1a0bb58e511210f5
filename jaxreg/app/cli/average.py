"""`jaxreg average`: poses from the relative motions of a g2o file."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.cli import outputs
from jaxreg.app.cli.by_hand import forced, left_out, motions_between, pairs_of, rooted
from jaxreg.app.cli.known import (
    is_told,
    known_entries,
    read_known,
    show_known,
    with_names,
    with_shown_noise,
    writable,
)
from jaxreg.app.cli.options import Average
from jaxreg.app.cli.runtime import Session, compile_in_a_hurry, key_of
from jaxreg.app.folder import result_folder
from jaxreg.app.plot import draw_graph, write_graph_report
from jaxreg.app.plot.chained import chained
from jaxreg.app.plot.results import MAX_COVARIANCES
from jaxreg.app.result import RESULT_FORMAT, write_json
from jaxreg.app.versions import versions
from jaxreg.averaging import (
    AveragingSolution,
    Correntropy,
    EdgeReport,
    MotionAveraging,
    WeightedMotionAveraging,
    average,
    edge_report,
    pose_covariances,
)
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o import read_g2o, read_g2o_poses, write_g2o
from jaxreg.io.graphs.g2o_known import KnownOfGraph
from jaxreg.io.graphs.redwood import read_log
from jaxreg.io.poses.tum import write_tum
from jaxreg.metrics import align_poses, chordal_objective


METHODS = {
    "correntropy": Correntropy,
    "plain": MotionAveraging,
    "weighted": WeightedMotionAveraging,
}
# Motions that are averaged in less than a second: compiling takes ten.
_QUICK = 10_000
FILES = ("result.json", "poses.tum", "graph.g2o", "figure.png", "report.html")


def run(command: Average, session: Session) -> int:
    """Runs the command; returns the exit code."""
    if command.budget is not None and command.budget < 1:
        raise InputError(f"--budget {command.budget}: wanted at least 1 step.")
    steps = {} if command.budget is None else {"max_steps": command.budget}
    method = METHODS[command.method](**steps)
    with session.timed("read"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        graph, ids = _read(command.graph)
        known = read_known(command, ids, graph.dim)
        dropped = motions_between(command.drop, graph, ids, "--drop")
        right = motions_between(command.force, graph, ids, "--force")
    graph = left_out(graph, dropped)
    if is_told(known):
        graph, note = with_shown_noise(graph)
    else:
        graph, ids, note = rooted(graph, ids)
    if note:
        session.console.print(note)
    for message in {str(w.message) for w in caught}:
        session.console.print(message)
    if graph.num_edges <= _QUICK:
        compile_in_a_hurry()
    key = key_of(command)
    with session.progress() as progress, session.timed("run", computes=True):
        progress("averaging", 0, 1)
        sol = average(graph, method=method, key=key, **known._asdict())
        if right.any():
            sol = forced(graph, sol, right, known._asdict())
        jax.block_until_ready(sol)
        progress("averaging", 1, 1)
    before = chained(graph, sol)
    if is_told(known):
        before = _beside(before, sol)
    objective = [float(chordal_objective(graph, s.T_world_i)) for s in (before, sol)]
    report = edge_report(graph, sol, **known._asdict())
    entries = with_names(known_entries(known, sol, report, ids), command)
    by_hand = {"dropped": pairs_of(graph, dropped, ids)} if dropped.any() else {}
    by_hand |= {"forced": pairs_of(graph, right, ids)} if right.any() else {}
    told = known, entries, by_hand
    _write(session, graph, before, sol, ids, objective, report, told)
    _show(session, graph, sol, objective)
    show_known(session, entries, known, report, ids)
    _show_residuals(session, report, ids)
    outputs.show_end(session, FILES, command.out)
    return 0


def _read(path: Path) -> tuple[PoseGraph, np.ndarray]:
    """The motions, and what the file calls the frames."""
    if path.suffix.lower() == ".log":
        graph = read_log(path)
        return graph, np.arange(graph.num_poses)
    ids, _ = read_g2o_poses(path)
    return read_g2o(path), ids


def _beside(before: AveragingSolution, sol: AveragingSolution) -> AveragingSolution:
    """Poses to compare with, moved to those of the answer as one body."""
    poses = before.T_world_i, sol.T_world_i
    T = align_poses(*poses, align="best", mask=sol.placed & before.placed)
    return dataclasses.replace(before, T_world_i=T)


def _write(
    session: Session,
    graph: PoseGraph,
    before: AveragingSolution,
    sol: AveragingSolution,
    ids: np.ndarray,
    objective: list[float],
    report: EdgeReport,
    told: tuple[KnownOfGraph, list[dict[str, Any]], dict[str, Any]],
) -> None:
    known, entries, by_hand = told
    poses = np.asarray(before.T_world_i), np.asarray(sol.T_world_i)
    drawn = np.asarray(graph.edges), *poses, np.asarray(sol.placed)
    with (
        result_folder(session.options.out) as staging,
        outputs.drawn_beside(session, staging / "figure.png", draw_graph, *drawn),
    ):
        with session.timed("write"):
            kept = writable(session, known, graph.dim)
            write_g2o(staging / "graph.g2o", graph, sol.T_world_i, ids, kept)
            placed = np.asarray(sol.placed)
            write_tum(
                staging / "poses.tum",
                np.asarray(sol.T_world_i)[placed],
                timestamps=ids[placed],
            )
        document = _document(sol, ids, objective) | _adjusted(graph, sol, ids, report)
        document |= by_hand
        if is_told(known):
            document["fixed"] = [int(ids[frame]) for frame, _ in known.fixed]
            document["known"] = entries
        document |= {
            "command": session.command,
            "seed": session.options.seed,
            "times_s": {k: round(v, 3) for k, v in session.times.items()},
            "versions": versions(),
            "files": list(FILES),
        }
        write_json(staging / "result.json", document)
        with outputs.page_or_message(session):
            write_graph_report(
                staging / "report.html",
                graph,
                sol,
                before,
                ids.tolist(),
                covariances=_covariances(graph, sol, known),
                known=entries,
                details=outputs.page_details(session, document)
                | {k: document[k] for k in ("objective_before", "objective_after")},
            )


def _covariances(graph: PoseGraph, sol: AveragingSolution, known: KnownOfGraph) -> Any:
    """For the page; None where the graph is too large for them."""
    if graph.num_poses > MAX_COVARIANCES:
        return None
    return pose_covariances(graph, sol, **known._asdict())


def _adjusted(
    graph: PoseGraph, sol: AveragingSolution, ids: np.ndarray, report: EdgeReport
) -> dict[str, Any]:
    """What the adjustment says of each motion, and of all."""
    edges, weights = np.asarray(graph.edges).tolist(), np.asarray(sol.edge_weight)
    return {
        "edges": [
            {
                "i": int(ids[i]),
                "j": int(ids[j]),
                "weight": float(weights[row]),
                "normalised_residual": float(report.normalised[row]),
                "redundancy": float(report.redundancy[row]),
            }
            for row, (i, j) in enumerate(edges)
        ],
        "adjustment": {
            "chi_square": report.chi_square,
            "degrees_of_freedom": report.degrees_of_freedom,
            "variance_factor": report.variance_factor,
            "p_value": report.p_value if report.prior_noise else None,
        },
    }


def _document(
    sol: AveragingSolution, ids: np.ndarray, objective: list[float]
) -> dict[str, Any]:
    status = Status(int(sol.status))
    poses = np.asarray(sol.T_world_i)
    return {
        "format": RESULT_FORMAT,
        "status": status.name,
        "advice": terminal_advice(status),
        "objective_before": objective[0],
        "objective_after": objective[1],
        "names": ids.tolist(),
        "T_world_i": [
            T.tolist() if ok else None
            for T, ok in zip(poses, np.asarray(sol.placed), strict=True)
        ],
    }


def _show(
    session: Session, graph: PoseGraph, sol: AveragingSolution, objective: list[float]
) -> None:
    status = Status(int(sol.status))
    num_edges = int(graph.mask.sum())
    table = Table(title=f"{graph.num_poses} poses, {num_edges} edges")
    table.add_column("poses")
    table.add_column("objective", justify="right")
    table.add_row("before (along a tree)", f"{objective[0]:.8g}")
    table.add_row("after", f"{objective[1]:.8g}")
    session.console.print(table)
    placed = np.asarray(sol.placed)
    trusted = int(np.sum(np.asarray(sol.edge_weight) > 0.5))
    session.console.print(
        f"{status.name}: {int(placed.sum())} of {len(placed)} poses placed, {trusted} "
        f"of {num_edges} edges trusted, {int(sol.num_steps)} steps."
    )
    if status != Status.CONVERGED:
        session.console.print(terminal_advice(status))
    session.console.print(
        "Objective: sum of kappa |R_j - R_i R_i_j|^2 + tau |t_j - t_i - R_i t_i_j|^2 "
        "(SE-Sync)."
    )


def _show_residuals(session: Session, report: EdgeReport, ids: np.ndarray) -> None:
    """The adjustment as surveyors read it."""
    table = Table(title="Largest residuals")
    for name in ("from", "to", "translation", "rotation (deg)", "normalised"):
        table.add_column(name, justify="right")
    known = not np.isnan(report.redundancy).any()  # of large graphs they are not
    if known:
        table.add_column("r", justify="right")
    for row in report.worst:
        i, j = report.edges[row]
        table.add_row(
            *(
                "world" if i < 0 else str(ids[i]),
                str(ids[j]),
                f"{report.translation[row]:.4g}",
            ),
            f"{np.rad2deg(report.rotation[row]):.4g}",
            f"{report.normalised[row]:.2f}",
            *([f"{report.redundancy[row]:.2f}"] if known else []),
        )
    session.console.print(table)
    if report.degrees_of_freedom > 0:
        told = (
            f"Chi-square {report.chi_square:.6g}, {report.degrees_of_freedom} degrees "
            f"of freedom, variance factor {report.variance_factor:.4g}."
        )
    else:
        told = "No motion is to spare, so nothing checks the others."
    meaning = "; r: redundancy number." if known else "."
    session.console.print(f"{told} Normalised: in standard deviations{meaning}")
