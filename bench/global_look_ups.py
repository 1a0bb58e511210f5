"""Success against the number of closest points that a search looks up.

All methods have the same parts; a budget scales how many poses they draw and carry.
The rivals of the filter are itself without dynamics (resampled, not moved), with
constant velocity, and descents from many starts, long ones and half as long.
"""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.global_data import SCAN_SETS, half, scan_pairs, so3
from bench.global_horse import PREPARED
from bench.global_prepared import Own
from bench.particle_horse import run_prepared, shift_of_model
from jaxreg.io.atomic import atomic_write
from jaxreg.particle import (
    AbstractSearch,
    ConstantVelocity,
    MultiStart,
    NoDynamics,
    ParticleFilter,
)
from jaxreg.plot.figure import figure_module


HORSE_BUDGETS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
SCAN_BUDGETS = (1 / 8, 1 / 4, 1 / 2, 1)
LEAST_OVERLAP = 0.1
# Colours that people who confuse red and green tell apart.
_COLORS = ("#0072b2", "#56b4e9", "#009e73", "#d55e00", "#e69f00")


class Workload(NamedTuple):
    """`run` tells which of the trials come out right, `(b,)`."""

    title: str
    base: ParticleFilter
    budgets: tuple[float, ...]
    run: Callable[[AbstractSearch], np.ndarray]


def methods(base: ParticleFilter, budget: float) -> dict[str, AbstractSearch]:
    """The filter scaled to a share of its look-ups, and rivals with as many."""
    carried = max(round(budget * base.num_particles), 2)
    drawn = max(round(budget * base.num_prior), carried)
    ours = replace(base, num_prior=drawn, num_particles=carried)
    starts = {
        f"many starts, {steps} steps": MultiStart(
            num_starts=max(ours.most_look_ups // (steps + 1), 1),
            num_steps=steps,
            num_points=base.num_points,
            num_modes=base.num_modes,
            refine_steps=base.refine_steps,
            width_start=base.width_start,
            width_end=base.width_end,
        )
        for steps in (27, 13)
    }
    return {
        "filter": ours,
        "no dynamics": replace(ours, dynamics=NoDynamics()),
        "constant velocity": replace(ours, dynamics=ConstantVelocity()),
        **starts,
    }


def workloads(num: int, model: np.ndarray, folder: Path) -> list[Workload]:
    """Horses, and pairs of scans where these are there."""
    found = []
    for title, draw, noise in (
        ("horse, any rotation, 35 % noise", so3, 0.35),
        ("half a horse, 25 % noise", half, 0.25),
    ):
        trials = draw(num, noise, model)

        def run(method: AbstractSearch, trials=trials) -> np.ndarray:
            got = run_prepared(method, trials)
            near = shift_of_model(got, trials) <= trials.shift
            return near & (got.degrees <= trials.degrees)

        found.append(Workload(title, PREPARED, HORSE_BUDGETS, run))
    sets = [scan_pairs(folder, x) for x in SCAN_SETS if (folder / x).is_dir()]
    if not sets:
        return found
    prepared = [(Own(ParticleFilter(), data), data) for data in sets]

    def run_scans(method: AbstractSearch) -> np.ndarray:
        return np.array(
            [
                data.correct(pair, own.solve(source, target, pair, method)[0])
                for own, data in prepared
                for pair, (target, source) in enumerate(data.pairs.tolist())
                if data.overlap[pair] >= LEAST_OVERLAP
            ]
        )

    title = f"pairs of scans, overlap {LEAST_OVERLAP:g} and more"
    return [*found, Workload(title, ParticleFilter(), SCAN_BUDGETS, run_scans)]


def compare(num: int, model: np.ndarray, folder: Path, out: Path) -> list[dict]:
    """Prints a table per workload and draws `look_ups.png`."""
    rows = []
    for work in workloads(num, model, folder):
        print(f"\n{work.title}: right, %\n{'look-ups':24s}", end="")
        counts = [
            m.most_look_ups * work.base.num_points
            for budget in work.budgets
            if isinstance(m := methods(work.base, budget)["filter"], ParticleFilter)
        ]
        print("".join(f"{count / 1e6:8.3f}M" for count in counts))
        for name in methods(work.base, 1):
            print(f"{name:24s}", end="")
            for budget, count in zip(work.budgets, counts, strict=True):
                right = work.run(methods(work.base, budget)[name])
                rows.append({"experiment": "look_ups", "workload": work.title})
                rows[-1] |= {"method": name, "look_ups": count, "trials": len(right)}
                rows[-1] |= {"success": 100 * float(right.mean())}
                print(f"{rows[-1]['success']:9.1f}", end="", flush=True)
            print()
    draw_picture(out / "look_ups.png", rows)
    return rows


def draw_picture(path: Path, rows: list[dict]) -> None:
    """One panel per workload, one line per method."""
    titles = list(dict.fromkeys(r["workload"] for r in rows))
    figure = figure_module().Figure(figsize=(3.7 * len(titles), 3.6), dpi=130)
    axes = figure.subplots(1, len(titles), squeeze=False)[0]
    for axis, title in zip(axes, titles, strict=True):
        here = [r for r in rows if r["workload"] == title]
        names = dict.fromkeys(r["method"] for r in here)
        for name, color in zip(names, _COLORS, strict=True):
            x, y = zip(
                *((r["look_ups"], r["success"]) for r in here if r["method"] == name),
                strict=True,
            )
            axis.plot(x, y, "o-", color=color, label=name, markersize=4)
        axis.set_xscale("log")
        counts = sorted({r["look_ups"] for r in here})
        axis.set_xticks(counts, [f"{count / 1e6:.2g} M" for count in counts])
        axis.minorticks_off()
        axis.set_title(f"{title} ({here[0]['trials']})", fontsize=9)
        axis.set_xlabel("closest points looked up", fontsize=9)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("found, %", fontsize=9)
    axes[0].legend(fontsize=8, frameon=False)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())
