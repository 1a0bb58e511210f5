"""Pictures of experiments: one trial before and after each method."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.records import Row
from bench.workloads.filter_data import EXPERIMENTS, moved
from jaxreg.app.plot.figure import new_figure, tilt
from jaxreg.io.atomic import atomic_write


_TARGET, _SOURCE = "#b4bac2", "#c1272d"


class Panel(NamedTuple):
    """Where a method puts the source; `T_target_source` is `(d+1, d+1)`."""

    title: str
    T_target_source: np.ndarray


def draw(rows: list[Row], out: Path, head: str) -> list[Path]:
    """Draws the first trial of each experiment; the files.

    Trials are drawn anew, as `samples` have the poses alone. Of kernel correlation, the
    bandwidth that finds most.
    """
    paths = []
    for name, trials_of in EXPERIMENTS.items():
        here = [r for r in rows if r.key.case == name and "found" in r.samples]
        rivals = [r for r in here if r.key.method.startswith("kernel correlation")]
        best = max(rivals, key=lambda r: r.value("success") or 0, default=None)
        shown = [r for r in here if r not in rivals or r is best]
        if not shown:
            continue
        trials = trials_of(shown[0].trials)
        paths.append(out / f"{head}_{name}.png")
        panels = [Panel("as given", np.eye(trials.target.shape[1] + 1))]
        panels += [_panel(row) for row in shown]
        trial_figure(paths[-1], trials.source[0], trials.target, panels)
    return paths


def _panel(row: Row) -> Panel:
    T = np.array(row.samples["T_target_source"])
    found, alike = (row.samples[key][0] for key in ("found", "as_shape"))
    verdict = "found" if found else "looks the same" if alike else "missed"
    title = (
        f"{row.key.method}\n{verdict}; found in {row.value('success'):.0f} % of trials"
    )
    return Panel(title, T.reshape(2 * [round(len(T) ** 0.5)]))


def trial_figure(
    path: Path, source: np.ndarray, target: np.ndarray, panels: list[Panel]
) -> None:
    """Draws a PNG: the target gray, the source red, all panels on one scale."""
    before = _seen(target)
    drawn = [_seen(moved(p.T_target_source, source.astype(float))) for p in panels]
    low = np.min([x.min(axis=0) for x in (before, *drawn)], axis=0)
    high = np.max([x.max(axis=0) for x in (before, *drawn)], axis=0)
    margin = 0.04 * (high - low).max()
    low, high = low - margin, high + margin
    flat = target.shape[1] == 2
    columns = 2 if flat else -(-len(panels) // 2)
    rows = -(-len(panels) // columns)
    width = 5.5 if flat else 3.0
    height = width * (high[1] - low[1]) / (high[0] - low[0]) + 0.6  # for the title
    figure = new_figure(figsize=(columns * width, rows * height), dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, panel, here in zip(axes, panels, drawn, strict=False):
        dot = 3.0 if flat else 9.0 if len(target) < 1000 else 2.5
        axis.scatter(*before.T, s=dot, color=_TARGET, linewidths=0)
        axis.scatter(*here.T, s=1.6 * dot, color=_SOURCE, linewidths=0)
        axis.set_title(panel.title, fontsize=9)
        axis.set_xlim(low[0], high[0])
        axis.set_ylim(low[1], high[1])
        axis.set_aspect("equal")
    figure.tight_layout(pad=0.6)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())


def _seen(points: np.ndarray) -> np.ndarray:
    """2D points as they are, those in space from a little above and aside."""
    if points.shape[1] == 2:
        return points
    up_second = points[:, [0, 2, 1]] * [1, 1, -1]
    return (up_second @ tilt(22.0, 35.0).T)[:, :2]
