"""`report.html`: a result as one page to turn, cut and question, without a network."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxreg
from jaxreg._core.checks import as_host_array
from jaxreg._core.status import Status
from jaxreg.app.colors import scan_colors
from jaxreg.app.plot.figure import principal_axes, tilt
from jaxreg.app.plot.report_curves import trace_curves
from jaxreg.app.plot.report_page import write_page
from jaxreg.app.plot.report_parts import (
    control_rows,
    details_entry,
    deviations,
    error_ellipsoid,
    prior_rows,
    status_entry,
)
from jaxreg.app.plot.report_points import encode_points, page_points
from jaxreg.app.plot.results import covariances_of, residuals, result_of
from jaxreg.app.result import Result


Solution: TypeAlias = (
    "jaxreg.RegistrationSolution | jaxreg.ReconstructionSolution | Result"
)


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
    moves, control points and how far they are off, the pairs with their trust and how
    far they are off, how the method came to rest, the poses, and how they were made.
    Components beside the model are shown in turn. It holds at most 64 000 points,
    2.5 MB with the drawing library, and loads nothing.

        sol = jaxreg.reconstruct(scans, key=key)
        jaxreg.app.plot.write_report("report.html", scans, sol)
        sol = jaxreg.register(source, target, key=key)
        jaxreg.app.plot.write_report("report.html", [target, source], sol)

    Args:
        path: the HTML file; it appears whole or not at all.
        scans: `(n_i, d)` arrays in the order of the solution, target first for a
            `RegistrationSolution`; rows with NaN or inf are left out.
        solution: what `register` or `reconstruct` returned, or a `Result`.
        names: of the scans, any text; by default those of a `Result`, target and source
            for a `RegistrationSolution`, else numbers.
        modes: for two scans, other poses of the second: `T_target_source`, `weight`
            and `fitness` as in `Modes`; those of a `RegistrationSolution` by default.
        covariances: `(v, k, k)` of the tangents of the poses, translation first; NaN
            where unknown. By default that of a `RegistrationSolution`, else by the
            trusted pairs.
        errors: against a known truth: `names`, `e_R` (radians), `e_t` (unit of the
            scans) and the means `mean_e_R`, `mean_e_t`.
        details: how the result was made: any of `command`, `seed`, `settings`,
            `times_s`, `versions` (those of this process by default), and `unit`, the
            name of that of lengths, such as "m", which is then shown beside them.

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plotly is not installed.
        ValueError: if scans and poses do not have the same number.
    """
    clouds = [as_host_array(x, f"scans[{i}]") for i, x in enumerate(scans)]
    if isinstance(solution, jaxreg.RegistrationSolution):
        modes = _modes_of(solution) if modes is None else modes
        if covariances is None:
            covariances = _covariances_of_pair(solution)
    if not isinstance(solution, Result):
        solution = result_of(solution, clouds, names)
    if covariances is None:
        covariances = covariances_of(solution)
    labels = list(solution.names if names is None else names)
    told = details is not None and "command" in details
    data = _page_data(clouds, solution, labels, modes, covariances, errors, told)
    data["details"] = details_entry(details)
    write_page(path, data["title"], data)


def _modes_of(solution: "jaxreg.RegistrationSolution") -> tuple[np.ndarray, ...]:
    """Its poses, their weights and fitness."""
    found = solution.modes
    every = (found.T_target_source, found.weight, found.fitness)
    return tuple(np.asarray(x) for x in every)


def _covariances_of_pair(solution: "jaxreg.RegistrationSolution") -> np.ndarray:
    """Of the target, which stays, and of the source."""
    covariance = np.asarray(solution.covariance)
    return np.stack([np.zeros_like(covariance), covariance])


def _page_data(
    clouds: list[np.ndarray],
    result: Result,
    labels: list[str],
    modes: tuple[np.ndarray, ...] | None,
    covariances: Any,
    errors: Mapping[str, Any] | None,
    at_terminal: bool,
) -> dict[str, Any]:
    """What the page shows, but for how it was made."""
    num = len(result.T_world_i)
    if len(clouds) != num:
        raise ValueError(f"scans: wanted {num} like the poses, found {len(clouds)}.")
    camera = _camera(clouds, result.T_world_i, result.placed)
    points = page_points(clouds, result.T_world_i, result.component, camera)
    pair = len(labels) == 2 and modes is not None
    return {
        "kind": "scans",
        "title": "Best attempt, not believed: " * result.attempt
        + _title(labels, pair, result.num_components),
        "dim": clouds[0].shape[1],
        "status": status_entry(result.status, at_terminal),
        "camera": None if camera is None else camera.tolist(),
        "points": encode_points(points),
        "scans": _scan_rows(result, clouds, labels, covariances, errors),
        "pairs": _pair_rows(result),
        "control": control_rows(result.known, result.names),
        "priors": prior_rows(result.known, result.names),
        "modes": _mode_rows(modes) if pair and modes is not None else [],
        "errors": None if errors is None else dict(errors),
        "curves": trace_curves(result.trace),
        "sigma_by": _sigma_by(result, pair),
    }


def _sigma_by(result: Result, pair: bool) -> str:
    """Where the standard deviations come from."""
    if pair or result.covariances is not None:
        return "how the pulls of all points scatter over the cells of the surfaces"
    return "what the trusted pairs show as noise"


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


def _title(names: list[str], pair: bool, models: int) -> str:
    if pair:
        return f"{names[1]} onto {names[0]}"
    frames = "one frame" if models == 1 else f"{models} frames"
    return f"{len(names)} scans in {frames}"


def _scan_rows(
    result: Result,
    clouds: list[np.ndarray],
    names: list[str],
    covariances: Any,
    errors: Mapping[str, Any] | None,
) -> list[dict[str, Any]]:
    sigma = deviations(covariances, len(names))
    known = {} if errors is None else {n: k for k, n in enumerate(errors["names"])}
    colors = np.round(255 * scan_colors(len(names))).astype(int)
    rows = []
    for i, name in enumerate(names):
        row = {
            "name": name,
            "color": colors[i].tolist(),
            "component": int(result.component[i]),
            "status": Status(int(result.scan_status[i])).name,
            "points": int(result.num_points[i]),
            "dropped": int(result.num_dropped[i]),
            "T": np.asarray(result.T_world_i[i], float).tolist(),
            "sigma": sigma[i].tolist(),
        }
        if result.covariances is not None and np.any(result.covariances[i] > 0):
            row |= error_ellipsoid(
                result.covariances[i], result.T_world_i[i], clouds[i]
            )
        if errors is not None and result.names[i] in known:
            k = known[result.names[i]]
            row |= {"e_R": errors["e_R"][k], "e_t": errors["e_t"][k]}
        rows.append(row)
    return rows


def _pair_rows(result: Result) -> list[dict[str, Any]]:
    angle, distance = residuals(result.T_world_i, result.edges, result.T_i_j)
    joined = result.component[result.edges]
    known = (joined[:, 0] == joined[:, 1]) & (joined[:, 0] >= 0)
    return [
        {
            "i": int(i),
            "j": int(j),
            "T": np.asarray(result.T_i_j[e], float).tolist(),
            "angle": float(angle[e]) if known[e] else None,
            "distance": float(distance[e]) if known[e] else None,
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
