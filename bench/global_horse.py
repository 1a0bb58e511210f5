"""Horses turned by any rotation, whole or half: success and time.

Success as in Table 1 of the PF paper: within 10 degrees, and the model's middle within
5 units of its place in the source's frame. The horse is its own mirror image, but no
rotation maps it on itself, so poses that look alike count as wrong.
"""

from collections.abc import Callable

import numpy as np

from bench.global_data import half, so3
from bench.particle_data import Trials
from bench.particle_horse import run_prepared, shift_of_model
from bench.particle_run import Method, Outcome, outcome, run
from bench.peers_global import GicpStarts, horse_peers, missing
from bench.timing import timed
from jaxreg.particle import MultiStart, ParticleFilter


# Draws trials, by their number and the share of noise, from a model, with a seed.
Draw = Callable[[int, float, np.ndarray, int], Trials]
WORKLOADS: dict[str, tuple[Draw, tuple[float, ...]]] = {
    "so3": (so3, (0.10, 0.25, 0.35)),
    "half": (half, (0.25,)),
}
# Trials of the other methods, which take a third of a second and more each.
_FEW = 50
_QUICK = ("model prepared once",)
# Those of seed 0 served to choose the settings below.
_SEED = 1
# Sparse points and few particles: the source has no normals, all of it is compared.
PREPARED = ParticleFilter(
    num_prior=768,
    num_particles=64,
    num_times=3,
    prior_steps=5,
    num_points=128,
    num_modes=6,
    refine_steps=10,
    width_start=0.4,
    width_end=0.1,
)


def own_methods() -> dict[str, Callable[[Trials], Outcome]]:
    """Of this package; all but `prepared` are calls of `register`."""
    calls = {
        "register()": ParticleFilter(),
        "register, MultiStart()": MultiStart(),
    }
    methods: dict[str, Callable[[Trials], Outcome]] = {
        name: lambda trials, m=method: run(Method("", m, False), trials)
        for name, method in calls.items()
    }
    methods["model prepared once"] = lambda trials: run_prepared(PREPARED, trials)
    return methods


def run_peer(peer: GicpStarts, trials: Trials) -> Outcome:
    """Each trial against the target prepared once, which is not timed."""
    target = peer.prepare(trials.target)

    def call() -> np.ndarray:
        answers = [
            peer.solve(peer.prepare(points), target, seed)
            for seed, points in enumerate(trials.source)
        ]
        return np.array([a.T_target_source for a in answers])

    took = timed(call)
    num = len(trials.source)
    return outcome(took.value, np.zeros(num, int), trials, 1000 * took.cpu / num)


def compare(
    workload: str, num: int, model: np.ndarray, names: list[str] | None
) -> list[dict]:
    """Prints the table of a workload; methods whose name contains one of `names`."""
    draw, noises = WORKLOADS[workload]
    methods = dict(own_methods())
    for name, peer in horse_peers().items():
        if why := missing("small_gicp"):
            print(f"{name}: {why}")
            continue
        methods[name] = lambda trials, p=peer: run_peer(p, trials)
    rows = []
    print(
        f"\n{workload}: 400 points on 4000, {num} trials\n{'noise':6s}{'':28s}"
        f"{'right':>10s}{'degrees':>8s}{'|t|':>8s}{'CPU ms':>9s}"
        "   errors: medians of the right ones"
    )
    for noise in noises:
        trials = draw(num, noise, model, _SEED)
        for name, method in methods.items():
            if names and not any(n in name for n in names):
                continue
            some = trials if name in _QUICK else _first(trials, _FEW)
            rows.append(_row(workload, noise, name, method(some), some))
            _print_row(rows[-1])
    return rows


def _first(trials: Trials, num: int) -> Trials:
    return trials._replace(
        source=trials.source[:num], T_target_source=trials.T_target_source[:num]
    )


def _row(
    workload: str, noise: float, name: str, found: Outcome, trials: Trials
) -> dict:
    shift = shift_of_model(found, trials)
    right = (found.degrees <= trials.degrees) & (shift <= trials.shift)
    return {
        "experiment": workload,
        "noise": noise,
        "method": name,
        "trials": len(shift),
        "right": int(right.sum()),
        "degrees": float(np.median(found.degrees[right])) if right.any() else None,
        "t": float(np.median(shift[right])) if right.any() else None,
        "cpu_ms": found.cpu_ms,
        "wrong": np.flatnonzero(~right).tolist(),
    }


def _print_row(row: dict) -> None:
    errors = [np.nan if row[k] is None else row[k] for k in ("degrees", "t")]
    print(
        f"{100 * row['noise']:3.0f} %  {row['method']:28s}{row['right']:5d}/"
        f"{row['trials']:<4d}{errors[0]:8.2f}{errors[1]:8.2f}{row['cpu_ms']:9.1f}",
        flush=True,
    )
