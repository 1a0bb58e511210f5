"""The picture of an averaged pose graph: its edges before and after."""

from typing import Any

import numpy as np

from jaxreg.app.plot.figure import new_figure, principal_axes, tilt


def draw_graph(
    edges: np.ndarray, T_before: np.ndarray, T_after: np.ndarray, placed: np.ndarray
) -> Any:
    """Draws every edge as a line between positions, before and after.

    Args:
        edges: `(e, 2)` frames i and j.
        T_before: `(v, d+1, d+1)` poses chained along a tree.
        T_after: `(v, d+1, d+1)` poses that were found.
        placed: `(v,)` frames that have a pose; edges to the others are left out.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        MissingExtraError: if matplotlib is not installed.
    """
    figure = new_figure(figsize=(10, 5), dpi=130)
    axes = figure.subplots(1, 2)
    edges = edges[placed[edges].all(axis=1)]
    after = _positions(T_after)
    turn, centre = np.eye(3), after.mean(axis=0)
    if after[:, 2].any():
        turn, centre = principal_axes(after[placed])
        # Most trajectories are flat: look down on them at an angle.
        turn = tilt(35.0, 0.0) @ turn[[1, 2, 0]]
    titles = ("before: along a spanning tree", "after")
    for axis, position, title in zip(
        axes, (_positions(T_before), after), titles, strict=True
    ):
        _draw(axis, ((position - centre) @ turn.T)[:, :2], edges)
        axis.set_title(title)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_axis_off()
    figure.subplots_adjust(left=0.02, right=0.98, top=0.92, bottom=0.02, wspace=0.04)
    return figure


def _positions(T: np.ndarray) -> np.ndarray:
    t = np.asarray(T, dtype=float)[:, :-1, -1]
    return np.pad(t, [(0, 0), (0, 3 - t.shape[1])])


def _draw(axis: Any, position: np.ndarray, edges: np.ndarray) -> None:
    chain = np.abs(edges[:, 0] - edges[:, 1]) == 1
    for kind, color in ((~chain, "#9db8d2"), (chain, "#1f4e79")):
        # One line with gaps is much faster than thousands of lines.
        ends = position[edges[kind]]
        gaps = np.full((len(ends), 1, 2), np.nan)
        line = np.concatenate([ends, gaps], axis=1).reshape(-1, 2)
        axis.plot(*line.T, color=color, linewidth=0.6)
