"""Success against the number of closest points that a search looks up.

All methods have the same parts; a budget scales how many poses they draw and carry.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bench.case import Case, Judged, Method, Options, Solve
from bench.records import share
from bench.workloads.filter_data import horse_model, horse_name
from bench.workloads.global_data import SCAN_SETS, ScanPairs, half, scan_pairs, so3
from bench.workloads.global_horse import PREPARED, judge, prepared
from bench.workloads.local_pairs import written_out
from bench.workloads.prepared_scans import Own
from jaxreg.particle import (
    AbstractSearch,
    ConstantVelocity,
    MultiStart,
    NoDynamics,
    ParticleFilter,
)


BUDGETS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
TRIALS = 100
#: Of real scans, every pair that overlaps by so much is searched.
SCAN_BUDGETS = (1 / 8, 1 / 4, 1 / 2, 1)
LEAST_OVERLAP = 0.1


def cases(options: Options) -> Iterator[Case]:
    """A case per kind of horse, or pairs of scans where there are, and budget."""
    yield from _horses(options)
    sets = [
        scan_pairs(options.data, x) for x in SCAN_SETS if (options.data / x).is_dir()
    ]
    if sets:
        yield from _scans(sets)


def _horses(options: Options) -> Iterator[Case]:
    folder = options.data / "horse"
    model = horse_model(folder)
    for title, draw, noise in (
        ("any rotation, 35 % noise", so3, 0.35),
        ("half, 25 % noise", half, 0.25),
    ):
        trials = draw(TRIALS, noise, model)
        for budget in BUDGETS:
            found = searches(PREPARED, budget)
            ours = found["jaxreg filter"]
            assert isinstance(ours, ParticleFilter)
            count = ours.most_look_ups * PREPARED.num_points
            yield Case(
                name=f"{title}, {count / 1e6:.3f} M",
                data=horse_name(folder),
                methods=[prepared(n, s, trials.target) for n, s in found.items()],
                trials=[(points, k) for k, points in enumerate(trials.source)],
                judge=partial(judge, trials),
                x=count,
                x_label=f"closest points looked up, {title}",
            )


def _scans(sets: list[ScanPairs]) -> Iterator[Case]:
    title = f"pairs of scans, overlap {LEAST_OVERLAP:g} and more"
    pairs = [
        (number, pair)
        for number, data in enumerate(sets)
        for pair in np.flatnonzero(data.overlap >= LEAST_OVERLAP).tolist()
    ]
    right = partial(_judge_scans, sets, pairs)
    for budget in SCAN_BUDGETS:
        found = searches(ParticleFilter(), budget)
        ours = found["jaxreg filter"]
        assert isinstance(ours, ParticleFilter)
        count = ours.most_look_ups * ours.num_points
        yield Case(
            name=f"{title}, {count / 1e6:.3f} M",
            data=", ".join(data.name for data in sets),
            methods=[
                Method(n, "jaxreg", written_out(s), prepare=partial(_between, s, sets))
                for n, s in found.items()
            ],
            trials=pairs,
            judge=right,
            x=count,
            x_label=f"closest points looked up, {title}",
        )


def _between(search: AbstractSearch, sets: list[ScanPairs]) -> Solve:
    """Scans prepared, and the search between two of a set."""
    own = [Own(search, data) for data in sets]

    def solve(number: int, pair: int) -> np.ndarray:
        target, source = sets[number].pairs[pair].tolist()
        return own[number].solve(source, target, pair)[0]

    return solve


def _judge_scans(
    sets: list[ScanPairs], pairs: list[tuple[int, int]], answers: list[Any]
) -> Judged:
    right = [
        sets[number].correct(pair, T)
        for (number, pair), T in zip(pairs, answers, strict=True)
    ]
    return Judged([share("success", np.array(right), 5.0)], {})


def searches(base: ParticleFilter, budget: float) -> dict[str, AbstractSearch]:
    """The filter scaled to a share of its look-ups, and rivals with as many."""
    carried = max(round(budget * base.num_particles), 2)
    drawn = max(round(budget * base.num_prior), carried)
    ours = replace(base, num_prior=drawn, num_particles=carried)
    starts = {
        f"jaxreg many starts, {steps} steps": MultiStart(
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
        "jaxreg filter": ours,
        "jaxreg no dynamics": replace(ours, dynamics=NoDynamics()),
        "jaxreg constant velocity": replace(ours, dynamics=ConstantVelocity()),
        **starts,
    }
