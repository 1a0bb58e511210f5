"""The experiments of the PF paper's section 5: letter, cube, truck, and Table 1.

The paper shows one run of each of the first three; here it is a hundred, each with its
own displacement, points and random numbers.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.records import Metric, error, share
from bench.workloads.filter_data import (
    EXPERIMENTS,
    Trials,
    horse,
    horse_model,
    horse_name,
)
from bench.workloads.filter_methods import HORSE, METHODS, PAPER, Tried, look_ups
from bench.workloads.filter_outcome import outcome, shift_of_model
from bench.workloads.global_horse import SEED, prepared
from bench.workloads.local_pairs import written_out
from bench.workloads.prepared_model import ours, with_l1
from jaxreg import register
from jaxreg.registrar import AbstractRegistrar


TRIALS = 100
#: As in the paper, for what is quick.
HORSES = 1000
#: Table 1, by the share of noise: mean, deviation and maximum of |t|, then of theta.
PUBLISHED = {
    0.05: ((0.73, 0.31, 1.86), (0.68, 0.57, 4.39)),
    0.10: ((1.23, 0.49, 3.04), (-0.29, 1.42, 3.99)),
    0.25: ((2.83, 0.87, 5.71), (-0.93, 2.61, 7.36)),
    0.35: ((3.82, 1.11, 7.53), (2.87, 2.05, 8.24)),
}


def cases(options: Options) -> Iterator[Case]:
    """A case per experiment; two per level of noise, as some methods are slow."""
    for name, draw in EXPERIMENTS.items():
        trials = draw(TRIALS)
        n, m = trials.source.shape[1], len(trials.target)
        yield Case(
            name=name,
            data=f"generated, {n} points on {m}, found within {trials.degrees:g} "
            f"degrees and a shift of {trials.shift:g}",
            methods=[method_of(tried, trials) for tried in METHODS[name]],
            trials=arguments(trials),
            judge=partial(judge, trials),
            reference=PAPER,
        )
    folder = options.data / "horse"
    model, data = horse_model(folder), horse_name(folder)
    for noise in PUBLISHED:
        name = f"Table 1, {noise:.0%} noise"
        many, few = (horse(num, noise, model, SEED) for num in (HORSES, TRIALS))
        quick = [
            prepared("40 particles, Geman-McClure", ours(), many.target),
            prepared("40 particles, L1", with_l1(), many.target),
            published(noise),
        ]
        yield _noisy(name, data, noise, quick, many)
        slow = [method_of(tried, few) for tried in HORSE]
        yield _noisy(f"{name}, the first {TRIALS}", data, noise, slow, few)


def _noisy(
    name: str, data: str, noise: float, methods: list[Method], trials: Trials
) -> Case:
    return Case(
        name=name,
        data=data,
        methods=methods,
        trials=arguments(trials),
        judge=partial(judge_table, trials),
        x=noise,
        x_label="share of noise",
    )


def arguments(trials: Trials) -> list[tuple]:
    """Of `solve`: the points and a seed."""
    return [(points, k) for k, points in enumerate(trials.source)]


def method_of(tried: Tried, trials: Trials) -> Method:
    """Registers one trial after the other; `look_ups` is what it may look up."""
    d = trials.target.shape[1]
    init = np.eye(d + 1, dtype=np.float32) if tried.from_identity else None
    guess = "from the pose as given" if tried.from_identity else "no guess"
    at_most = look_ups(tried.registrar, trials)
    return Method(
        name=tried.name,
        library="jaxreg",
        parameters=f"{written_out(tried.registrar)}, {guess}",
        solve=partial(_solve, tried.registrar, trials.target, init),
        metrics=[Metric("look_ups", at_most, "", "down")],
    )


def _solve(
    registrar: AbstractRegistrar,
    target: np.ndarray,
    init: np.ndarray | None,
    points: np.ndarray,
    seed: int,
) -> np.ndarray:
    found = register(points, target, registrar, init, jax.random.key(seed))
    return np.asarray(found.T_target_source, float)


def published(noise: float) -> Method:
    """The paper's line of Table 1."""
    shift, angle = PUBLISHED[noise]
    text = "1,000 trials on its own horse"
    metrics = [*offsets("t", "units", *shift), *offsets("theta", "deg", *angle)]
    return Method("the paper's Table 1", "published", text, metrics=metrics)


def judge(trials: Trials, answers: list[Any]) -> Judged:
    """Found, or in a pose that looks the same; errors of all; the first pose."""
    found = outcome(np.array(answers), trials)
    metrics = [share("success", found.success, 5.0)]
    if len(trials.shape_turns) > 1:
        metrics.append(share("as_shape", found.aligned, 5.0))
    metrics += [
        error("e_rot", float(np.median(found.degrees)), "deg", 0.05),
        error("e_trans", float(np.median(found.shift)), "units", 0.05),
    ]
    first = {
        "T_target_source": found.T_target_source[0].ravel().tolist(),
        "found": [float(found.success[0])],
        "as_shape": [float(found.aligned[0])],
    }
    return Judged(metrics, first)


def judge_table(trials: Trials, answers: list[Any]) -> Judged:
    """The columns of Table 1 over all trials, and the median of the whole rotation."""
    found = outcome(np.array(answers), trials)
    shift = shift_of_model(found, trials)
    theta = _about_z(found.T_target_source, trials.T_target_source)
    right = (found.degrees <= trials.degrees) & (shift <= trials.shift)
    return Judged(
        [
            share("success", right, 5.0),
            *offsets("t", "units", shift.mean(), shift.std(), shift.max()),
            *offsets("theta", "deg", theta.mean(), theta.std(), abs(theta).max()),
            error("e_rot", float(np.median(found.degrees)), "deg", 0.02),
        ]
    )


def _about_z(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Signed degrees by which the source was turned too far about z, `(b,)`."""
    gap = np.swapaxes(T[:, :3, :3], 1, 2) @ truth[:, :3, :3]
    y, x = gap[:, 1, 0] - gap[:, 0, 1], gap[:, 0, 0] + gap[:, 1, 1]
    return np.rad2deg(np.arctan2(y, x))


def offsets(
    of: str, unit: str, mean: float, deviation: float, most: float
) -> list[Metric]:
    """Mean, deviation and largest size of an error, as in Table 1."""
    values = {"mean": mean, "dev": deviation, "max": most}
    return [Metric(f"{of}_{k}", float(v), unit, "down") for k, v in values.items()]
