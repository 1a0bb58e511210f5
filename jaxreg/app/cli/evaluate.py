"""`jaxreg evaluate`: poses or motions of pairs against true ones."""

import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxreg import metrics
from jaxreg.app.cli.options import Evaluate
from jaxreg.app.plot import save_figure
from jaxreg.app.plot.errors import draw_pair_errors, draw_pose_errors
from jaxreg.app.result import without_nan, write_json
from jaxreg.app.trajectories import Trajectory, read_trajectory
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.atomic import atomic_folder
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.redwood import read_info


def run(command: Evaluate) -> int:
    """Runs the command; returns the exit code."""
    if command.delta < 1:
        raise InputError(f"--delta {command.delta}: wanted at least 1.")
    with jax.enable_x64(True):
        found, truth = map(read_trajectory, (command.estimate, command.truth))
        if (len(found.T_world_i), len(truth.T_world_i)) == (2, 1):
            # The result of `register`, and one matrix: of the source in the target.
            pair = PoseGraph.from_edges([(0, 1)], truth.T_world_i)
            truth = truth._replace(pairs=pair)
        if truth.pairs is not None:
            document, figure = _pairs(command, found, truth.pairs)
        elif found.pairs is not None:
            raise InputError(
                f"{command.estimate}: holds motions of pairs, {command.truth} poses.\n"
                "Give the true motions (gt.log), or average the pairs first."
            )
        else:
            document, figure = _poses(command, found, truth)
    if command.out is not None:
        with atomic_folder(command.out) as staging:
            write_json(staging / "evaluation.json", document)
            save_figure(staging / "evaluation.png", figure)
    if command.json:
        sys.stdout.write(json.dumps(without_nan(document), indent=1) + "\n")
    else:
        _show(document, command.out)
    return 0


def _poses(
    command: Evaluate, found: Trajectory, truth: Trajectory
) -> tuple[dict[str, Any], Any]:
    """What is told of poses, and its picture."""
    rows, true_rows, labels = _common(command, found, truth)
    T, T_true = found.T_world_i[rows], truth.T_world_i[true_rows]
    if command.delta >= len(rows):
        raise InputError(
            f"--delta {command.delta}: wanted less than the {len(rows)} frames that "
            "both have."
        )
    if T.shape != T_true.shape:
        raise InputError(
            f"{command.estimate}: is {T.shape[-1] - 1}D, but {command.truth} is "
            f"{T_true.shape[-1] - 1}D."
        )
    aligned = metrics.align_poses(T, T_true, command.align)
    e_R = np.asarray(metrics.rotation_errors(aligned, T_true, "none"))
    e_t = np.asarray(metrics.translation_errors(aligned, T_true, "none"))
    turn, shift = map(np.asarray, metrics.relative_errors(T, T_true, command.delta))
    document = {
        "kind": "poses",
        "align": command.align,
        "delta": command.delta,
        "num_poses": [len(rows), len(found.T_world_i), len(truth.T_world_i)],
        "e_R": float(e_R.mean()),
        "e_t": float(e_t.mean()),
        "APE": {"translation": _statistics(e_t), "rotation": _statistics(e_R)},
        "RPE": {"translation": _statistics(shift), "rotation": _statistics(turn)},
        "frames": labels,
        "errors": {"e_R": e_R.tolist(), "e_t": e_t.tolist()},
    }
    return document, draw_pose_errors(np.asarray(aligned), T_true, e_R, e_t)


def _statistics(x: np.ndarray) -> dict[str, float]:
    """As evo calls them."""
    if not len(x):
        x = np.array([np.nan])
    squares = float(np.sum(x**2))
    return {
        "rmse": float(np.sqrt(squares / len(x))),
        "mean": float(x.mean()),
        "median": float(np.median(x)),
        "std": float(x.std()),
        "min": float(x.min()),
        "max": float(x.max()),
        "sse": squares,
    }


def _common(
    command: Evaluate, found: Trajectory, truth: Trajectory
) -> tuple[list[int], list[int], list[Any]]:
    """The rows of both that are of one frame: by name, by timestamp, or in order."""
    if found.names is not None and truth.names is not None:
        row = {name: k for k, name in enumerate(found.names)}
        both = [(row[n], k) for k, n in enumerate(truth.names) if n in row]
    elif found.timed and truth.timed:
        gap = np.abs(truth.stamps[:, None] - found.stamps)
        nearest = gap.argmin(axis=1)
        both = [
            (int(i), k)
            for k, i in enumerate(nearest)
            # Each is the other's nearest: none is used twice.
            if gap[k, i] <= command.max_difference and gap[:, i].argmin() == k
        ]
    elif len(found.T_world_i) == len(truth.T_world_i):
        both = [(k, k) for k in range(len(truth.T_world_i))]
    else:
        raise InputError(
            f"{command.estimate}: holds {len(found.T_world_i)} poses, {command.truth} "
            f"{len(truth.T_world_i)}, and nothing tells which are of one frame.\n"
            "Give names (.json, .conf) or timestamps (TUM) in both."
        )
    if len(both) < 2:
        raise InputError(
            f"{command.estimate} and {command.truth}: have {len(both)} frames in "
            "common, by names or timestamps.\nGive poses of the same frames."
        )
    rows, true_rows = (list(x) for x in zip(*both, strict=True))
    labels = truth.stamps if truth.names is None else np.array(truth.names)
    return rows, true_rows, labels[true_rows].tolist()


def _pairs(
    command: Evaluate, found: Trajectory, truth: PoseGraph
) -> tuple[dict[str, Any], Any]:
    """What is told of motions of pairs, and its picture."""
    graph = found.pairs if found.pairs is not None else _motions(found, truth)
    known = _either_way(graph)
    e_R, e_t = np.full(truth.num_edges, np.inf), np.full(truth.num_edges, np.inf)
    T_true = np.asarray(truth.T_i_j, np.float64)
    for e, (i, j) in enumerate(np.asarray(truth.edges).tolist()):
        if (i, j) in known:
            one = known[i, j][None], T_true[e][None], "none"
            e_R[e] = metrics.rotation_errors(*one)[0]
            e_t[e] = metrics.translation_errors(*one)[0]
    both = np.isfinite(e_R)
    document: dict[str, Any] = {
        "kind": "pairs",
        "num_pairs": [int(both.sum()), graph.num_edges, truth.num_edges],
        "e_R": _statistics(e_R[both]),
        "e_t": _statistics(e_t[both]),
    }
    info, rmse = command.truth.with_suffix(".info"), None
    if info.exists():
        pairs, information = read_info(info)
        if not np.array_equal(pairs, np.asarray(truth.edges)):
            raise InputError(f"{info}: holds other pairs than {command.truth}.")
        counted = metrics.registration_recall(
            graph, truth, information, command.threshold
        )
        rmse = counted.rmse
        names = ("recall", "precision", "num_right", "num_true", "num_found")
        document |= {name: getattr(counted, name) for name in names}
        document["threshold"] = command.threshold
    return document, draw_pair_errors(e_R, e_t, rmse, command.threshold)


def _either_way(graph: PoseGraph) -> dict[tuple[int, int], np.ndarray]:
    """`T_i_j` by (i, j), and its inverse by (j, i) where no other is known."""
    edges = np.asarray(graph.edges).tolist()
    T = np.asarray(graph.T_i_j, np.float64)
    back = np.linalg.inv(T)
    out = {(j, i): back[e] for e, (i, j) in enumerate(edges)}
    return out | {(i, j): T[e] for e, (i, j) in enumerate(edges)}


def _motions(found: Trajectory, truth: PoseGraph) -> PoseGraph:
    """Between the poses of the pairs of the truth, whose numbers are the stamps."""
    number = {int(s): k for k, s in enumerate(found.stamps)}
    pairs = [(i, j) for i, j in np.asarray(truth.edges).tolist()]
    pairs = [(i, j) for i, j in pairs if i in number and j in number]
    if not pairs:
        raise InputError("The poses are of none of the true pairs.")
    T = found.T_world_i
    motions = [np.linalg.inv(T[number[i]]) @ T[number[j]] for i, j in pairs]
    return PoseGraph.from_edges(pairs, np.stack(motions), truth.num_poses)


def _show(document: dict[str, Any], out: Path | None) -> None:
    console = Console(highlight=False, markup=False)
    columns = ("rmse", "mean", "median", "std", "min", "max")
    table = Table("error", title_justify="left", box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right")
    if document["kind"] == "poses":
        num, given, true = document["num_poses"]
        table.title = f"{num} frames in common, of {given} and {true} poses"
        groups = [(kind, what) for kind in ("APE", "RPE") for what in document[kind]]
        rows = [(f"{kind} {what}", document[kind][what]) for kind, what in groups]
    else:
        num, given, true = document["num_pairs"]
        table.title = f"{num} pairs in common, of {given} and {true}"
        rows = [("rotation", document["e_R"]), ("translation", document["e_t"])]
    for name, told in rows:
        unit = " [rad]" if "rotation" in name else ""
        table.add_row(name + unit, *(f"{told[c]:.3g}" for c in columns))
    console.print(table)
    if document["kind"] == "poses":
        console.print(
            f"e_R = {document['e_R']:.5g} rad, e_t = {document['e_t']:.5g}: means, as "
            f"in the MCC paper; aligned by: {document['align']}."
        )
    if "recall" in document:
        console.print(
            f"Registration recall {document['recall']:.4f} ({document['num_right']} of "
            f"{document['num_true']}), precision {document['precision']:.4f} (of "
            f"{document['num_found']}), pairs of successive fragments left out."
        )
    if out is not None:
        console.print(f"Written to {out}: evaluation.json, evaluation.png.")
