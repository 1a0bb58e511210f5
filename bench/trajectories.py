"""The picture of trajectories: a line per graph, a panel per method."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench.records import Row
from jaxreg.app.plot.figure import new_figure
from jaxreg.io.atomic import atomic_write


_PATH, _CLEAN, _FALSE = "#1f4e79", "#c9c9c9", "#d1495b"
#: The first shows the false closures, too.
METHODS = (
    "odometry",
    "jaxreg PoseGraphLM",
    "jaxreg MCC paper, from odometry",
    "GTSAM Geman-McClure, from odometry",
    "GTSAM GNC, from odometry",
    "jaxreg default",
)


def trajectories(rows: list[Row], path: Path) -> Path | None:
    """Draws a PNG of the rows that have positions `x`, `y` among their samples.

    Those are of the first trial, as is the first `e_t`, their distance from the clean
    optimum.
    """
    rows = [row for row in rows if "x" in row.samples]
    cases = list(dict.fromkeys(row.key.case for row in rows))
    if not cases:
        return None
    columns, height = len(METHODS), 3.2 * len(cases) + 0.3
    figure = new_figure(figsize=(2.7 * columns, height), dpi=130)
    axes = figure.subplots(len(cases), columns, squeeze=False)
    for line, case in zip(axes, cases, strict=True):
        here = {row.key.method: row for row in rows if row.key.case == case}
        # The clean optimum is no distance off itself.
        clean = _positions(min(here.values(), key=lambda row: row.value("e_t") or 0.0))
        for axis, method in zip(line, METHODS, strict=True):
            axis.set_axis_off()
            if method in here:
                _panel(axis, here[method], clean)
        line[0].annotate(
            case,
            (0, 1),
            (0, 36),
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
        top=1 - 0.8 / height,
        bottom=0.25 / height,
        wspace=0.04,
        hspace=0.3,
    )
    drawn, buffer = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png")
    # Few colours are in it: a palette makes the file a quarter as large.
    palette = Image.open(drawn).convert("RGB").quantize(32)
    palette.save(buffer, format="png", optimize=True)
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())
    return path


def _positions(row: Row) -> np.ndarray:
    return np.stack([row.samples["x"], row.samples["y"]], axis=1)


def _panel(axis: Any, row: Row, clean: np.ndarray) -> None:
    """In the same window for all methods: the clean optimum and a margin."""
    found = _positions(row)
    axis.plot(*clean.T, color=_CLEAN, linewidth=2.2)
    if row.key.method == METHODS[0]:
        for ends in np.reshape(row.samples["false"], (-1, 2)).astype(int):
            axis.plot(*found[ends].T, color=_FALSE, linewidth=0.4, alpha=0.5)
    axis.plot(*found.T, color=_PATH, linewidth=0.7)
    axis.set_title(f"{row.key.method}\n{row.samples['e_t'][0]:.2g} m off", fontsize=9)
    low, high = clean.min(axis=0), clean.max(axis=0)
    middle, half = (low + high) / 2, 0.56 * float(np.max(high - low))
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_aspect("equal", adjustable="box")
