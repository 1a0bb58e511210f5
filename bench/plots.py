"""Plots of a workload's rows."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench import start_plot, trial_plot
from bench.records import Row
from bench.trajectories import trajectories
from jaxreg.app.plot.figure import new_figure
from jaxreg.io.atomic import atomic_write


# Colours that people who confuse red and green tell apart; the first for jaxreg.
_COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
    "#999933", "#882255", "#44aa99", "#661100",
)  # fmt: skip


class Series(NamedTuple):
    """A metric over what a series of cases varies, one panel per series."""

    metric: str
    label: str
    log_x: bool
    log_y: bool
    methods: tuple[str, ...] = ()  # all if empty


SERIES = {
    "local_pairs": Series(
        "cpu_ms",
        "CPU time of a pair, ms",
        True,
        True,
        (
            "jaxreg ICP",
            "jaxreg ICP, pose alone",
            "NumPy+SciPy plane",
            "small_gicp GICP",
            "small_gicp GICP voxel 0.01",
            "small_gicp PLANE",
            "Open3D plane",
            "Open3D GICP",
            "probreg FilterReg",
            "pycpd CPD",
        ),
    ),
    "global_horse": Series(
        "e_rot", "rotation error of the found, degrees", False, True
    ),
    "filter_paper": Series("t_mean", "mean error of translation, units", False, True),
    "look_ups": Series("success", "found, %", True, False),
    "neighbours": Series("cpu_ms", "CPU time of all queries, ms", True, True),
    "averaging_outliers": Series("success", "right, %", False, False),
    "large_graphs": Series("cpu_ms", "CPU time, ms", True, True),
    "multiview_size": Series("cpu_ms", "CPU time of a call, ms", True, True),
}


def draw(workload: str, mode: str, rows: list[Row], out: Path) -> list[Path]:
    """Draws what there is of this workload; the files."""
    rows = [row for row in rows if row.status == "ok"]
    head = workload if mode == "full" else f"{workload}_{mode}"
    found = []
    if workload in SERIES:
        found.append(_series(SERIES[workload], rows, out / f"{head}.png"))
    if workload in ("global_scans", "global_horse"):
        found.append(_success_by_error(rows, out / f"{head}_by_error.png"))
    if workload == "global_scans":
        found.append(_success_by_overlap(rows, out / f"{head}_by_overlap.png"))
    if workload == "false_closures":
        found.append(trajectories(rows, out / f"{head}.png"))
    if workload == "devices":
        found.append(_devices(rows, out / f"{head}.png"))
    if workload == "command_line":
        found.append(start_plot.draw(rows, out / f"{head}.png", _COLORS))
    if workload == "filter_paper":
        found += trial_plot.draw(rows, out, head)
    return [path for path in found if path is not None]


def _series(series: Series, rows: list[Row], path: Path) -> Path | None:
    rows = [
        r
        for r in rows
        if r.x is not None
        and series.metric in r.metrics
        and (not series.methods or r.key.method in series.methods)
    ]
    labels = list(dict.fromkeys(r.x_label for r in rows))
    labels = [s for s in labels if len({r.x for r in rows if r.x_label == s}) > 1]
    if not labels:
        return None
    styles = _styles(rows)

    def panel(axis: Any, label: str) -> None:
        # In ascending order also where a case was finished by a later call.
        here = sorted((r for r in rows if r.x_label == label), key=lambda r: r.x or 0)
        for method, style in styles.items():
            points = [
                (r.x, r.metrics[series.metric]) for r in here if r.key.method == method
            ]
            if not points:
                continue
            x = [p[0] for p in points]
            axis.plot(x, [p[1].value for p in points], label=method, **style)
            if all(p[1].spread for p in points):
                low, high = zip(*(p[1].spread for p in points), strict=True)
                axis.fill_between(x, low, high, color=style["color"], alpha=0.12, lw=0)
        axis.set_xscale("log" if series.log_x else "linear")
        if series.log_x:
            # At what was measured: labels between powers of ten collide.
            ticks = sorted({r.x for r in rows if r.x_label == label and r.x})
            axis.set_xticks(ticks, [f"{tick:,.10g}" for tick in ticks])
            axis.tick_params(axis="x", labelsize=7, rotation=30)
            axis.minorticks_off()
        axis.set_yscale("log" if series.log_y else "linear")
        axis.set_xlabel(label, fontsize=9)
        axis.set_ylabel(series.label, fontsize=9)

    return _figure(path, labels, panel)


def _styles(rows: list[Row]) -> dict[str, dict]:
    """Of each method: those of jaxreg thick."""
    names = dict.fromkeys(
        r.key.method for r in sorted(rows, key=lambda r: r.library != "jaxreg")
    )
    own = {r.key.method for r in rows if r.library == "jaxreg"}
    return {
        name: {
            "color": _COLORS[at % len(_COLORS)],
            "linewidth": 2.4 if name in own else 1.3,
            "linestyle": "-" if name in own else "--",
            "marker": "o",
            "markersize": 4,
        }
        for at, name in enumerate(names)
    }


def _success_by_error(rows: list[Row], path: Path) -> Path | None:
    """Share of trials whose rotation error is below what is on the axis."""
    rows = [r for r in rows if "e_rot" in r.samples]
    cases = list(dict.fromkeys(r.key.case for r in rows))
    styles = _styles(rows)

    def panel(axis: Any, case: str) -> None:
        for row in (r for r in rows if r.key.case == case):
            errors = np.sort(row.samples["e_rot"])
            share = 100 * np.arange(1, len(errors) + 1) / len(errors)
            style = styles[row.key.method] | {"marker": ""}
            axis.step(np.maximum(errors, 1e-2), share, where="post",
                      label=row.key.method, **style)  # fmt: skip
        axis.set_xscale("log")
        axis.set_xlim(1e-2, 180)
        axis.set_ylim(0, 102)
        axis.set_title(case, fontsize=9)
        axis.set_xlabel("rotation error below, degrees", fontsize=9)
        axis.set_ylabel("trials, %", fontsize=9)

    return _figure(path, cases, panel) if cases else None


def _success_by_overlap(rows: list[Row], path: Path) -> Path | None:
    """Share of right pairs over the overlap at the truth, in steps of a tenth."""
    rows = [r for r in rows if "overlap" in r.samples]
    cases = list(dict.fromkeys(r.key.case for r in rows))
    styles = _styles(rows)

    def panel(axis: Any, case: str) -> None:
        for row in (r for r in rows if r.key.case == case):
            overlap, right = (np.array(row.samples[k]) for k in ("overlap", "right"))
            step = np.minimum(overlap * 10, 9).astype(int)
            there = np.unique(step)
            share = [100 * right[step == s].mean() for s in there]
            axis.plot(there / 10 + 0.05, share, label=row.key.method,
                      **styles[row.key.method])  # fmt: skip
        axis.set_title(case, fontsize=9)
        axis.set_xlabel("overlap at the truth", fontsize=9)
        axis.set_ylabel("right, %", fontsize=9)
        axis.set_ylim(-2, 102)

    return _figure(path, cases, panel) if cases else None


def _devices(rows: list[Row], path: Path) -> Path | None:
    """Rates beside each other, where there is more than one device."""
    cases = list(dict.fromkeys(r.key.case for r in rows))
    cases = [c for c in cases if sum(r.key.case == c for r in rows) > 1]

    def panel(axis: Any, case: str) -> None:
        for at, row in enumerate(r for r in rows if r.key.case == case):
            rate = next(m for m in row.metrics.values() if m.key.endswith("_per_s"))
            axis.barh([at], [rate.value], color=_COLORS[at], label=row.key.method)
            axis.set_xlabel(rate.key.replace("_per_s", " a second"), fontsize=9)
        axis.set_yticks([])
        axis.set_title(case, fontsize=9)

    return _figure(path, cases, panel) if cases else None


def _figure(path: Path, names: list[str], panel: Callable[[Any, str], None]) -> Path:
    """A panel for each name and one legend, as a PNG."""
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure = new_figure(
        figsize=(3.6 * columns + 2.4, 3.1 * lines), dpi=110, layout="constrained"
    )
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    legend: dict[str, Any] = {}
    for axis, name in zip(axes, names, strict=False):
        panel(axis, name)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
        handles, labels = axis.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    figure.legend(
        legend.values(), legend, loc="outside right center", fontsize=8, frameon=False
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())
    return path
