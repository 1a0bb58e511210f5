"""`report.html` of an averaged pose graph."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxreg
from jaxreg._core.status import Status
from jaxreg.app.plot.chained import chained
from jaxreg.app.plot.figure import principal_axes, tilt
from jaxreg.app.plot.report_curves import trace_curves
from jaxreg.app.plot.report_page import write_page
from jaxreg.app.plot.report_parts import (
    control_rows,
    details_entry,
    deviations,
    floats,
    prior_rows,
    raw,
    status_entry,
)
from jaxreg.app.plot.results import MAX_COVARIANCES, residuals


_MAX_ROWS = 400


def write_graph_report(
    path: str | Path,
    graph: "jaxreg.PoseGraph",
    solution: "jaxreg.AveragingSolution",
    before: "jaxreg.AveragingSolution | None" = None,
    names: Sequence[Any] | None = None,
    *,
    covariances: Any = None,
    known: Sequence[Mapping[str, Any]] = (),
    details: Mapping[str, Any] | None = None,
) -> None:
    """Writes an averaged pose graph as one HTML page that opens from disk.

    The page shows the positions and edges before and after, control points, the edges
    by whether they are trusted and how far they are off, beside the width of the
    kernel, how the steps came to rest, the poses, and how they were made.

    Args:
        path: the HTML file; it appears whole or not at all.
        graph: the relative motions.
        solution: what `average` made of them.
        before: poses to compare with; None for those along a spanning tree.
        names: of the frames; their numbers by default.
        covariances: `(v, k, k)`; by default, for some hundred frames, those that
            `pose_covariances` gives.
        known: what `known` of result.json holds of these frames.
        details: as in `write_report`, and `objective_before`, `objective_after`.

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plotly is not installed.
    """
    if before is None:
        before = chained(graph, solution)
    num = graph.num_poses
    ids = range(num) if names is None else names
    labels = [str(x) for x in ids]
    if covariances is None and num <= MAX_COVARIANCES:
        covariances = jaxreg.pose_covariances(graph, solution)
    sigma = deviations(covariances, num)
    edges = _edge_data(graph, solution)
    title = f"{num:,} poses from {int(np.sum(graph.mask)):,} edges"
    poses = _pose_data(solution, before, labels, sigma)
    told = details is not None and "command" in details
    how = _solver_data(solution, told)
    data = {"kind": "graph", "title": title, "dim": graph.dim, **poses, **edges, **how}
    data["control"] = control_rows(known, ids)
    data["priors"] = prior_rows(known, ids)
    data["details"] = details_entry(details)
    write_page(path, title, data)


def _pose_data(
    solution: "jaxreg.AveragingSolution",
    before: "jaxreg.AveragingSolution",
    labels: list[str],
    sigma: np.ndarray,
) -> dict[str, Any]:
    """Positions before and after, about their middle, and the table of poses."""
    T = np.asarray(solution.T_world_i, np.float64)
    old = np.asarray(before.T_world_i, np.float64)
    placed = np.asarray(solution.placed, bool)
    origin = np.median(T[placed][:, :-1, -1], axis=0)
    return {
        "camera": _camera_on_path(T),
        "origin": origin.tolist(),
        "num_placed": int(placed.sum()),
        "num_poses": len(T),
        "before": floats(old[:, :-1, -1] - origin),
        "after": floats(T[:, :-1, -1] - origin),
        "placed": raw(placed.astype(np.uint8)),
        "names": labels,
        "scans": _rows(labels, placed, T, sigma),
    }


def _edge_data(
    graph: "jaxreg.PoseGraph", solution: "jaxreg.AveragingSolution"
) -> dict[str, Any]:
    """Edges that are not masked, their trust and how far they are off."""
    keep = np.asarray(graph.mask)
    edges = np.asarray(graph.edges)[keep]
    weight = np.asarray(solution.edge_weight, np.float64)[keep]
    T = np.asarray(solution.T_world_i, np.float64)
    angle, distance = residuals(T, edges, np.asarray(graph.T_i_j)[keep])
    return {
        "num_trusted": int(np.sum(weight > 0.5)),
        "edges": raw(edges.astype("<i4")),
        "weight": floats(weight),
        "angle": floats(angle),
        "distance": floats(distance),
    }


def _solver_data(
    solution: "jaxreg.AveragingSolution", at_terminal: bool
) -> dict[str, Any]:
    """How the method came to rest."""
    return {
        "status": status_entry(Status(int(solution.status)), at_terminal),
        "kernel_width": np.asarray(solution.kernel_width, np.float64).tolist(),
        "steps": int(solution.num_steps),
        "residual": float(solution.residual),
        "curves": trace_curves(solution.trace, int(solution.num_steps)),
    }


def _rows(
    names: list[str], placed: np.ndarray, T_world_i: np.ndarray, sigma: np.ndarray
) -> list[dict[str, Any]]:
    """Of the table of poses, which does not show thousands."""
    return [
        {"name": name, "placed": bool(ok), "T": T.tolist(), "sigma": s.tolist()}
        for name, ok, T, s in zip(
            names[:_MAX_ROWS], placed, T_world_i, sigma, strict=False
        )
    ]


def _camera_on_path(T_world_i: np.ndarray) -> list[list[float]] | None:
    """Most trajectories are flat: look down on them at an angle."""
    if T_world_i.shape[1] == 3:
        return None
    axes, _ = principal_axes(T_world_i[:, :3, 3])
    return (tilt(35.0, 0.0) @ axes[[1, 2, 0]]).tolist()
