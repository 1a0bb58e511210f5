"""What the methods of solutions show: `plot`, `to_html`, `show`, and the table."""

import html
import os
import sys
import tempfile
import webbrowser
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxreg
from jaxreg._core.checks import is_concrete
from jaxreg._core.status import Status
from jaxreg.plot.figure import draw_reconstruction
from jaxreg.plot.graph import draw_graph
from jaxreg.plot.report import write_report
from jaxreg.plot.report_graph import write_graph_report
from jaxreg.plot.results import result_of


Solution: TypeAlias = (
    jaxreg.RegistrationSolution
    | jaxreg.ReconstructionSolution
    | jaxreg.AveragingSolution
)
_MAX_ROWS = 30


def plot_solution(
    solution: Solution, data: Sequence[Any], names: Sequence[str] | None
) -> Any:
    """The figure of `Solution.plot`."""
    _require_one(solution)
    if isinstance(solution, jaxreg.AveragingSolution):
        graph = _graph(data)
        before = jaxreg.average(graph, jaxreg.SpanningTree(by="path"))
        return draw_graph(
            np.asarray(graph.edges)[np.asarray(graph.mask)],
            np.asarray(before.T_world_i, np.float64),
            np.asarray(solution.T_world_i, np.float64),
            np.asarray(solution.placed),
        )
    clouds = _clouds(solution, data)
    result = result_of(solution, clouds, names)
    return draw_reconstruction(clouds, result.T_world_i, result.names, result.component)


def write_solution(
    solution: Solution,
    path: str | Path,
    data: Sequence[Any],
    names: Sequence[str] | None,
) -> None:
    """The page of `Solution.to_html`."""
    _require_one(solution)
    if isinstance(solution, jaxreg.AveragingSolution):
        write_graph_report(path, _graph(data), solution, names=names)
    else:
        write_report(path, _clouds(solution, data), solution, names)


def show_solution(
    solution: Solution, data: Sequence[Any], names: Sequence[str] | None
) -> Path:
    """The page of `Solution.show`, opened where there is a screen."""
    path = Path(tempfile.mkdtemp(prefix="jaxreg-")) / "report.html"
    write_solution(solution, path, data, names)
    screens = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform != "linux" or any(os.environ.get(name) for name in screens):
        webbrowser.open(path.as_uri())
    return path


def solution_table(solution: Solution) -> str | None:
    """Status, advice and the main numbers as HTML; None while tracing."""
    if not is_concrete(solution.status):
        return None
    if np.ndim(solution.status):
        counts = Counter(np.ravel(solution.status).tolist())
        rows = [[Status(k).name, f"{num:,}"] for k, num in counts.most_common()]
        return _table(f"{np.size(solution.status):,} problems", rows)
    status = Status(int(solution.status))
    title = repr(solution) if status == Status.CONVERGED else f"{solution!r}. "
    title += "" if status == Status.CONVERGED else status.advice
    if isinstance(solution, jaxreg.RegistrationSolution):
        return _table(title, _matrix(solution.T_target_source))
    if isinstance(solution, jaxreg.ReconstructionSolution):
        component = np.asarray(solution.component)
        scans = [
            [f"scan {k}", Status(int(s)).name, "" if c < 0 else f"component {c}"]
            for k, (s, c) in enumerate(
                zip(solution.scan_status, component, strict=True)
            )
        ]
        return _table(title, scans)
    position = np.asarray(solution.T_world_i)[:, :-1, -1]
    poses = [
        [f"frame {k}", *(f"{x:.6g}" for x in t)] if placed else [f"frame {k}", "lost"]
        for k, (t, placed) in enumerate(
            zip(position[:_MAX_ROWS], solution.placed, strict=False)
        )
    ]
    return _table(title, poses, len(position))


def _matrix(T: Any) -> list[list[str]]:
    return [[f"{x:.6g}" for x in row] for row in np.asarray(T)]


def _table(title: str, rows: list[list[str]], num: int | None = None) -> str:
    num = len(rows) if num is None else num
    lines = [
        "<tr>" + "".join(f"<td>{html.escape(x)}</td>" for x in row) + "</tr>"
        for row in rows[:_MAX_ROWS]
    ]
    more = num - len(lines)
    rest = f"<p>and {more:,} more</p>" if more > 0 else ""
    return f"<p>{html.escape(title)}</p><table>{''.join(lines)}</table>{rest}"


def _require_one(solution: Solution) -> None:
    if np.ndim(solution.status):
        raise ValueError(
            f"solution: wanted one, found a batch of {np.shape(solution.status)}; "
            "jax.tree.map(lambda x: x[k], sol) is lane k."
        )


def _graph(data: Sequence[Any]) -> jaxreg.PoseGraph:
    if len(data) != 1 or not isinstance(data[0], jaxreg.PoseGraph):
        raise ValueError("data: wanted the PoseGraph that was averaged.")
    return data[0]


def _clouds(solution: Solution, data: Sequence[Any]) -> list[np.ndarray]:
    """Points in the order of the poses; crosses where none are given."""
    pair = isinstance(solution, jaxreg.RegistrationSolution)
    num = 2 if pair else len(solution.T_world_i)
    given = [data[1], data[0]] if pair and len(data) == 2 else data
    given = list(data[0]) if not pair and len(data) == 1 else given
    if not len(given):
        return [_cross(solution)] * num
    if len(given) != num:
        wanted = "source and target" if pair else f"a list of {num} scans"
        raise ValueError(f"data: wanted {wanted}, found {len(given)} arrays.")
    return [np.asarray(x) for x in given]


def _cross(solution: Solution) -> np.ndarray:
    """A frame as points along its axes, x longer than y longer than z."""
    pair = isinstance(solution, jaxreg.RegistrationSolution)
    T = np.asarray(solution.T_target_source[None] if pair else solution.T_world_i)
    d = T.shape[-1] - 1
    far = np.linalg.norm(T[:, :d, d] - T[0, :d, d] * (not pair), axis=1)
    size = 0.2 * float(np.median(far[far > 0])) if np.any(far > 0) else 1.0
    steps = np.linspace(0, size, 200)
    lengths = 1 - 0.3 * np.arange(d)
    return (steps[:, None, None] * np.diag(lengths)).reshape(-1, d)
