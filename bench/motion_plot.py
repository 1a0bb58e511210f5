"""The picture of trajectories: one line per graph, one panel per method."""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxreg.io.atomic import atomic_write
from jaxreg.plot.figure import new_figure, principal_axes, tilt


_PATH, _CLEAN, _FALSE = "#1f4e79", "#c9c9c9", "#d1495b"
_MOST_FALSE = 60


class Panel(NamedTuple):
    """Poses that a method found, in the frame of the last panel of its line."""

    title: str
    T_world_i: np.ndarray
    false_edges: np.ndarray  # (n, 2)
    label: str = ""


def trajectories_figure(path: Path, lines: list[list[Panel]]) -> None:
    """Draws a PNG; the last panel of a line is its reference, gray in the others."""
    num, height = max(len(line) for line in lines), 3.0 * len(lines) + 0.3
    figure = new_figure(figsize=(2.7 * num, height), dpi=130)
    axes = figure.subplots(len(lines), num, squeeze=False)
    for row, line in zip(axes, lines, strict=True):
        turn, centre = _camera(line[-1].T_world_i)
        clean = _seen(line[-1].T_world_i, turn, centre)
        for axis, panel in zip(row, line, strict=True):
            here = _seen(panel.T_world_i, turn, centre)
            axis.plot(*clean.T, color=_CLEAN, linewidth=2.2)
            _false_edges(axis, here, panel.false_edges)
            axis.plot(*here.T, color=_PATH, linewidth=0.7)
            axis.set_title(panel.title, fontsize=9)
            axis.set_axis_off()
            _window(axis, clean)
        row[0].annotate(
            line[0].label,
            (0, 1),
            (0, 24),
            xycoords="axes fraction",
            textcoords="offset points",
            weight="bold",
            annotation_clip=False,
        )
    note = "gray: clean optimum; blue: found; red: some of the false closures"
    figure.text(0.99, 0.05 / height, note, ha="right", fontsize=8, color="#555555")
    figure.subplots_adjust(
        left=0.01,
        right=0.99,
        top=1 - 0.6 / height,
        bottom=0.25 / height,
        wspace=0.04,
        hspace=0.25,
    )
    drawn, buffer = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png")
    # Few colours are in it: a palette makes the file a quarter as large.
    palette = Image.open(drawn).convert("RGB").quantize(32)
    palette.save(buffer, format="png", optimize=True)
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())


def _camera(T_world_i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    position = _positions(T_world_i)
    if not position[:, 2].any():
        return np.eye(3), position.mean(axis=0)
    turn, centre = principal_axes(position)
    # Most trajectories are flat: look down on them at an angle.
    return tilt(35.0, 0.0) @ turn[[1, 2, 0]], centre


def _positions(T: np.ndarray) -> np.ndarray:
    t = T[:, :-1, -1]
    return np.pad(t, [(0, 0), (0, 3 - t.shape[1])])


def _seen(T: np.ndarray, turn: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return ((_positions(T) - centre) @ turn.T)[:, :2]


def _window(axis: Any, clean: np.ndarray) -> None:
    """The same window in all panels: the reference and a margin."""
    low, high = clean.min(axis=0), clean.max(axis=0)
    middle, half = (low + high) / 2, 0.56 * float(np.max(high - low))
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_aspect("equal", adjustable="box")


def _false_edges(axis: Any, position: np.ndarray, edges: np.ndarray) -> None:
    some = edges[:: max(1, len(edges) // _MOST_FALSE)]
    for ends in position[some]:
        axis.plot(*ends.T, color=_FALSE, linewidth=0.4, alpha=0.5)
