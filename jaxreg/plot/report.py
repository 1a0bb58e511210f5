"""`report.html`: a result as one page to turn, cut and question, without a network."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxreg
from jaxreg._core.status import Status
from jaxreg.io.colors import scan_colors
from jaxreg.io.result import Result, versions
from jaxreg.plot.figure import principal_axes, tilt
from jaxreg.plot.report_page import write_page
from jaxreg.plot.report_points import encode_points, page_points


Solution: TypeAlias = (
    "jaxreg.RegistrationSolution | jaxreg.ReconstructionSolution | Result"
)
_MAX_ROWS = 400


def write_report(
    path: str | Path,
    scans: Sequence[Any],
    solution: Solution,
    names: Sequence[str] | None = None,
    *,
    modes: tuple[np.ndarray, ...] | None = None,
    covariances: Any = None,
    errors: Mapping[str, Any] | None = None,
    details: Mapping[str, Any] | None = None,
) -> None:
    """Writes scans and their poses as one HTML page that opens from disk.

    The page shows the scans before and after in a view that turns, a cross-section that
    moves, the pairs with their trust, the poses, and how they were made. It holds at
    most 110 000 points, about 6 MB with the drawing library, and loads nothing.

        sol = jaxreg.reconstruct(scans, key=key)
        jaxreg.plot.write_report("report.html", scans, sol)
        sol = jaxreg.register(source, target, key=key)
        jaxreg.plot.write_report("report.html", [target, source], sol)

    Args:
        path: the HTML file; it appears whole or not at all.
        scans: `(n_i, d)` arrays in the order of the solution, target first for a
            `RegistrationSolution`; rows with NaN or inf are left out.
        solution: what `register` or `reconstruct` returned, or a `Result`.
        names: of the scans, any text; those of a `Result` by default, else numbers.
        modes: for two scans, other poses of the second: `T_target_source`, `weight`
            and `fitness` as in `Modes`; those of a `RegistrationSolution` by default.
        covariances: `(v, k, k)` of the tangents of the poses, translation first; NaN
            where unknown. That of a `RegistrationSolution` by default.
        errors: against a known truth: `names`, `e_R` (radians), `e_t` (unit of the
            scans) and the means `mean_e_R`, `mean_e_t`.
        details: how the result was made: any of `command`, `seed`, `settings`,
            `times_s`, `versions` (those of this process by default).

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plotly is not installed.
        ValueError: if scans and poses do not have the same number.
    """
    clouds = [np.asarray(s) for s in scans]
    result = solution
    if isinstance(solution, jaxreg.RegistrationSolution):
        found = solution.modes
        if modes is None:
            modes = (
                np.asarray(found.T_target_source),
                np.asarray(found.weight),
                np.asarray(found.fitness),
            )
        if covariances is None:
            fixed = np.zeros_like(solution.covariance)
            covariances = np.stack([fixed, np.asarray(solution.covariance)])
    if not isinstance(result, Result):
        result = _result(result, clouds, names)
    num = len(result.T_world_i)
    if len(clouds) != num:
        raise ValueError(f"scans: wanted {num} like the poses, found {len(clouds)}.")
    labels = list(result.names if names is None else names)
    placed = np.asarray(result.placed, bool)
    camera = _camera(clouds, result.T_world_i, placed)
    points = page_points(clouds, result.T_world_i, placed, camera)
    pair = len(labels) == 2 and modes is not None
    data = {
        "kind": "scans",
        "title": _title(labels, pair),
        "dim": clouds[0].shape[1],
        "status": _status(result.status),
        "camera": None if camera is None else camera.tolist(),
        "points": encode_points(points),
        "scans": _scan_rows(result, labels, covariances, errors),
        "pairs": _pair_rows(result),
        "modes": _mode_rows(modes) if pair and modes is not None else [],
        "errors": None if errors is None else dict(errors),
        "details": _details(details),
    }
    write_page(path, data["title"], data)


def write_graph_report(
    path: str | Path,
    graph: "jaxreg.PoseGraph",
    solution: "jaxreg.AveragingSolution",
    before: "jaxreg.AveragingSolution",
    names: Sequence[Any] | None = None,
    *,
    covariances: Any = None,
    details: Mapping[str, Any] | None = None,
) -> None:
    """Writes an averaged pose graph as one HTML page that opens from disk.

    The page shows the positions and edges before and after, the edges by whether they
    are trusted, the poses, and how they were made.

    Args:
        path: the HTML file; it appears whole or not at all.
        graph: the relative motions.
        solution: what `average` made of them.
        before: poses to compare with, for instance those of `SpanningTree()`.
        names: of the frames; their numbers by default.
        covariances: `(v, k, k)` as `pose_covariances` gives them.
        details: as in `write_report`, and `objective_before`, `objective_after`.

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plotly is not installed.
    """
    T = np.asarray(solution.T_world_i, np.float64)
    labels = [str(x) for x in (range(len(T)) if names is None else names)]
    placed = np.asarray(solution.placed, bool)
    keep = np.asarray(graph.mask)
    edges = np.asarray(graph.edges)[keep]
    weight = np.asarray(solution.edge_weight, np.float64)[keep]
    origin = np.median(T[placed][:, :-1, -1], axis=0)
    old = np.asarray(before.T_world_i, np.float64)
    width = np.asarray(solution.kernel_width, np.float64)
    shown = min(len(T), _MAX_ROWS)
    sigma = _deviations(covariances, len(T))
    title = f"{len(T):,} poses from {len(edges):,} edges"
    data = {
        "kind": "graph",
        "title": title,
        "dim": graph.dim,
        "status": _status(Status(int(solution.status))),
        "camera": _camera_on_path(T),
        "num_placed": int(placed.sum()),
        "num_poses": len(T),
        "num_trusted": int(np.sum(weight > 0.5)),
        "before": _floats(old[:, :-1, -1] - origin),
        "after": _floats(T[:, :-1, -1] - origin),
        "placed": _bytes(placed.astype(np.uint8)),
        "edges": _bytes(edges.astype("<i4")),
        "weight": _floats(weight),
        "names": labels,
        "scans": [
            {
                "name": labels[i],
                "placed": bool(placed[i]),
                "T": T[i].tolist(),
                "sigma": sigma[i].tolist(),
            }
            for i in range(shown)
        ],
        "kernel_width": width.tolist(),
        "steps": int(solution.num_steps),
        "residual": float(solution.residual),
        "details": _details(details),
    }
    write_page(path, title, data)


def _result(
    solution: "jaxreg.RegistrationSolution | jaxreg.ReconstructionSolution",
    clouds: list[np.ndarray],
    names: Sequence[str] | None,
) -> Result:
    status = Status(int(solution.status))
    size = np.array([len(x) for x in clouds])
    finite = np.array([np.isfinite(x).all(axis=1).sum() for x in clouds])
    if isinstance(solution, jaxreg.RegistrationSolution):
        T = np.asarray(solution.T_target_source, np.float64)
        found = status in (Status.CONVERGED, Status.MAX_STEPS, Status.AMBIGUOUS)
        poses = np.stack([np.eye(len(T)), T])
        component = np.where([True, found], 0, -1)
        scan_status = np.array([Status.CONVERGED, status])
        edges, T_i_j, keep = np.array([[0, 1]]), T[None], slice(None)
        weight = np.array([float(found)])
    else:
        poses = np.asarray(solution.T_world_i, np.float64)
        component = np.asarray(solution.component)
        scan_status = np.asarray(solution.scan_status)
        keep = np.asarray(solution.graph.mask)
        edges = np.asarray(solution.graph.edges)[keep]
        T_i_j = np.asarray(solution.graph.T_i_j, np.float64)[keep]
        weight = np.asarray(solution.edge_weight)[keep]
    labels = [f"scan {k}" for k in range(len(poses))] if names is None else list(names)
    return Result(
        names=labels,
        T_world_i=poses,
        component=component,
        status=status,
        scan_status=scan_status,
        num_points=size,
        num_dropped=size - finite,
        edges=edges,
        T_i_j=T_i_j,
        overlap=np.atleast_1d(solution.overlap)[keep],
        weight=weight,
        inlier_rmse=np.atleast_1d(solution.inlier_rmse)[keep],
    )


def _camera(
    clouds: list[np.ndarray], T_world_i: np.ndarray, placed: np.ndarray
) -> np.ndarray | None:
    """Rows right, up and towards the viewer."""
    if clouds[0].shape[1] == 2:
        return None
    model = [
        x[np.isfinite(x).all(axis=1)][:: 1 + len(x) // 20_000] @ T[:3, :3].T + T[:3, 3]
        for x, T, ok in zip(clouds, T_world_i, placed, strict=True)
        if ok
    ]
    axes, _ = principal_axes(np.concatenate(model))
    up = 1 + int(np.argmax(np.abs(axes[1, 1:])))
    if axes[1, up] < 0:
        # Files have y or z upwards, if anything: no model shall stand on its head.
        axes = axes * np.array([[-1], [-1], [1]])
    return tilt(20.0, 25.0) @ axes


def _camera_on_path(T_world_i: np.ndarray) -> list[list[float]] | None:
    """Most trajectories are flat: look down on them at an angle."""
    if T_world_i.shape[1] == 3:
        return None
    axes, _ = principal_axes(T_world_i[:, :3, 3])
    return (tilt(35.0, 0.0) @ axes[[1, 2, 0]]).tolist()


def _title(names: list[str], pair: bool) -> str:
    return f"{names[1]} onto {names[0]}" if pair else f"{len(names)} scans in one frame"


def _status(status: Status) -> dict[str, str]:
    return {"name": status.name, "advice": status.advice}


def _scan_rows(
    result: Result,
    names: list[str],
    covariances: Any,
    errors: Mapping[str, Any] | None,
) -> list[dict[str, Any]]:
    sigma = _deviations(covariances, len(names))
    known = {} if errors is None else {n: k for k, n in enumerate(errors["names"])}
    colors = np.round(255 * scan_colors(len(names))).astype(int)
    rows = []
    for i, name in enumerate(names):
        row = {
            "name": name,
            "color": colors[i].tolist(),
            "placed": bool(result.placed[i]),
            "status": Status(int(result.scan_status[i])).name,
            "points": int(result.num_points[i]),
            "dropped": int(result.num_dropped[i]),
            "T": np.asarray(result.T_world_i[i], float).tolist(),
            "sigma": sigma[i].tolist(),
        }
        if errors is not None and result.names[i] in known:
            k = known[result.names[i]]
            row |= {"e_R": errors["e_R"][k], "e_t": errors["e_t"][k]}
        rows.append(row)
    return rows


def _pair_rows(result: Result) -> list[dict[str, Any]]:
    return [
        {
            "i": int(i),
            "j": int(j),
            "weight": float(result.weight[e]),
            "overlap": float(result.overlap[e]),
            "rmse": float(result.inlier_rmse[e]),
        }
        for e, (i, j) in enumerate(result.edges)
    ]


def _mode_rows(modes: tuple[np.ndarray, ...]) -> list[dict[str, Any]]:
    return [
        {"T": np.asarray(T, float).tolist(), "weight": float(w), "fitness": float(f)}
        for T, w, f in zip(*modes, strict=True)
        if w > 0
    ]


def _deviations(covariances: Any, num: int) -> np.ndarray:
    """`(v, 2)` standard deviations: of the position, and of the rotation in radians."""
    if covariances is None:
        return np.full((num, 2), np.nan)
    C = np.asarray(covariances, np.float64)
    variance = np.diagonal(C, axis1=1, axis2=2)
    d = 2 if C.shape[-1] == 3 else 3
    return np.sqrt(
        np.stack([variance[:, :d].sum(axis=1), variance[:, d:].sum(axis=1)], axis=1)
    )


def _details(details: Mapping[str, Any] | None) -> dict[str, Any]:
    return {"versions": versions(), **({} if details is None else details)}


def _floats(x: np.ndarray) -> str:
    return _bytes(x.astype("<f4"))


def _bytes(x: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(x).tobytes()).decode("ascii")
