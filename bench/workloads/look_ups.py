"""Success against the number of closest points that a search looks up.

All methods have the same parts; a budget scales how many poses they draw and carry.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from bench.case import Case, Options
from bench.particle_data import horse_model
from bench.workloads.global_data import half, so3
from bench.workloads.global_horse import PREPARED, judge, prepared
from jaxreg.particle import (
    AbstractSearch,
    ConstantVelocity,
    MultiStart,
    NoDynamics,
    ParticleFilter,
)


BUDGETS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
TRIALS = 100


def cases(options: Options) -> Iterator[Case]:
    """A case per kind of horse and budget."""
    folder = options.data / "horse"
    model = horse_model(folder)
    scanned = (folder / "horse.ply.gz").is_file()
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
                data="scanned horse" if scanned else "generated horse",
                methods=[prepared(n, s, trials.target) for n, s in found.items()],
                trials=[(points, k) for k, points in enumerate(trials.source)],
                judge=partial(judge, trials),
                x=count,
                x_label=f"closest points looked up, {title}",
            )


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
