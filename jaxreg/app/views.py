"""Solutions to look at: a figure, a page, the page in the browser."""

import os
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxreg
from jaxreg._core.checks import as_host_array
from jaxreg.app.plot.chained import chained
from jaxreg.app.plot.figure import draw_reconstruction
from jaxreg.app.plot.graph import draw_graph
from jaxreg.app.plot.report import write_report
from jaxreg.app.plot.report_graph import write_graph_report
from jaxreg.app.plot.results import result_of


Solution: TypeAlias = (
    jaxreg.RegistrationSolution
    | jaxreg.ReconstructionSolution
    | jaxreg.AveragingSolution
)


def draw(solution: Solution, *data: Any, names: Sequence[str] | None = None) -> Any:
    """Draws the data before and after.

    Args:
        solution: one; lane k of a batch is `jax.tree.map(lambda x: x[k], sol)`.
        data: what the solver was given, as it was given: source and target for
            `register`, the scans for `reconstruct`, the graph for `average`. Without
            them frames stand for the scans.
        names: of the scans or frames, for the legend.

    Returns:
        A `matplotlib.figure.Figure`; notebooks show it, `savefig` writes it.

    Raises:
        MissingExtraError: if a package of the extra `app` is not installed.
        ValueError: for a batch of solutions, or data that do not fit.

    Example:
        >>> import jaxreg as jr
        >>> from jaxreg.app import views
        >>> T = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> graph = jr.PoseGraph.from_edges([(0, 1), (1, 2)], [T, T])
        >>> sol = jr.average(graph, jr.SpanningTree())
        >>> len(views.draw(sol, graph).axes)
        2
    """
    _require_one(solution)
    if isinstance(solution, jaxreg.AveragingSolution):
        graph = _graph(data)
        before = chained(graph, solution)
        return draw_graph(
            np.asarray(graph.edges)[np.asarray(graph.mask)],
            np.asarray(before.T_world_i, np.float64),
            np.asarray(solution.T_world_i, np.float64),
            np.asarray(solution.placed),
        )
    clouds = _clouds(solution, data)
    result = result_of(solution, clouds, names)
    return draw_reconstruction(clouds, result.T_world_i, result.names, result.component)


def write_page(
    path: str | Path,
    solution: Solution,
    *data: Any,
    names: Sequence[str] | None = None,
) -> None:
    """Writes a page to turn, cut and question, which opens without a network.

    Args:
        path: the HTML file; it appears whole or not at all.
        solution: one solution.
        data: as for `draw`.
        names: of the scans or frames.

    Raises: as `draw`; InputError if the file cannot be written.
    """
    _require_one(solution)
    if isinstance(solution, jaxreg.AveragingSolution):
        write_graph_report(path, _graph(data), solution, names=names)
    else:
        write_report(path, _clouds(solution, data), solution, names)


def show(solution: Solution, *data: Any, names: Sequence[str] | None = None) -> Path:
    """Opens the page of `write_page` in the browser, where there is a screen.

    Returns:
        The page, in a temporary folder.

    Raises: as `write_page`.
    """
    path = Path(tempfile.mkdtemp(prefix="jaxreg-")) / "report.html"
    write_page(path, solution, *data, names=names)
    open_where_seen(path.as_uri())
    return path


def open_where_seen(address: str) -> None:
    """Opens a page in the browser, where there is a screen."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform != "linux" or any(os.environ.get(name) for name in screens):
        webbrowser.open(address)


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
    return [as_host_array(x, f"data[{i}]") for i, x in enumerate(given)]


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
