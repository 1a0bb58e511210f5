"""`Solution`: what solvers return, and the ways to look at it.

Pictures are drawn by `jaxreg.plot`, which is loaded when one is asked for: a program
that asks for none needs no drawing library.
"""

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax


class Solution(eqx.Module):
    """Arrays that one solve returned; of a batch with leading axes.

    The methods take the data that the solver was given, as it was given: source and
    target for `register`, the scans for `reconstruct`, the graph for `average`. Without
    them frames stand for the scans. They look at one solution, on the host:
    `jax.tree.map(lambda x: x[k], sol)` is lane k of a batch.

        >>> import pathlib, tempfile
        >>> import jaxreg as jr
        >>> T = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> graph = jr.PoseGraph.from_edges([(0, 1), (1, 2)], [T, T])
        >>> sol = jr.average(graph, jr.SpanningTree())
        >>> len(sol.plot(graph).axes)
        2
        >>> page = pathlib.Path(tempfile.mkdtemp()) / "graph.html"
        >>> sol.to_html(page, graph)
        >>> page.exists()
        True
    """

    status: eqx.AbstractVar[jax.Array]

    def plot(self, *data: Any, names: Sequence[str] | None = None) -> Any:
        """Draws the data before and after.

        Args:
            data: what the solver was given, or nothing.
            names: of the scans or frames, for the legend.

        Returns:
            A `matplotlib.figure.Figure`; notebooks show it, `savefig` writes it.

        Raises:
            ImportError: if a package of the extra `app` is not installed.
            ValueError: for a batch of solutions, or data that do not fit.
        """
        return _drawn("plot_solution")(self, data, names)

    def to_html(
        self, path: str | Path, *data: Any, names: Sequence[str] | None = None
    ) -> None:
        """Writes a page to turn, cut and question, which opens without a network.

        Args:
            path: the HTML file; it appears whole or not at all.
            data: what the solver was given, or nothing.
            names: of the scans or frames.

        Raises:
            ImportError: if a package of the extra `app` is not installed.
            ValueError: for a batch of solutions, or data that do not fit; if the file
                cannot be written.
        """
        _drawn("write_solution")(self, path, data, names)

    def show(self, *data: Any, names: Sequence[str] | None = None) -> Path:
        """Opens the page of `to_html` in the browser.

        Returns:
            The page, in a temporary folder: where no browser can be opened it still
            is there.

        Raises: as `to_html`.
        """
        return _drawn("show_solution")(self, data, names)

    def _repr_html_(self) -> str | None:
        """A table, for notebooks; they print the repr where it is None."""
        try:
            return _drawn("solution_table")(self)
        except ImportError:
            return None


def _drawn(name: str) -> Callable[..., Any]:
    try:
        views = importlib.import_module("jaxreg.plot.views")
    except ModuleNotFoundError as err:
        raise ImportError(
            f"Pictures need the package {err.name}, which is not installed.\n"
            "Install it with: python -m pip install 'jaxreg[app]'"
        ) from err
    return getattr(views, name)
