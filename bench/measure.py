"""Measures one case: all methods in turn, then what each needs of memory."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench import timing
from bench.case import Case, Method, Solve
from bench.memory import growth_mib
from bench.peers import missing
from bench.records import Key, Metric, Row


def measure(
    case: Case,
    methods: list[Method],
    blank: Callable[[Method], Row],
    before: Callable[[str], None] = lambda name: None,
) -> list[Row]:
    """A row for each method; one that is absent or fails has a row that says so.

    Args:
        case: what is solved.
        methods: those of the case that are wanted.
        blank: the row of a method with its key, before anything is known.
        before: told the name of the method before each of its calls.
    """
    rows, solves, prepared = {}, {}, {}
    for method in methods:
        row = _described(case, method, blank(method))
        rows[method.name] = row
        if method.library == "published":
            known = {m.key: m for m in method.metrics}
            rows[method.name] = replace(row, metrics=known)
            continue
        if why := missing(method.library):
            rows[method.name] = replace(row, status="absent", why=why)
            continue
        before(method.name)
        try:
            solves[method.name], seconds = _prepared(method)
        except Exception as err:  # another version of a peer
            why = str(err) or type(err).__name__
            rows[method.name] = replace(row, status="failed", why=f"prepare: {why}")
            continue
        if seconds is not None:
            prepared[method.name] = seconds
    first, calls, failed = timing.in_turn(
        solves,
        case.trials,
        0 if case.once else case.repeats,
        warm_up=case.warm_up,
        before=before,
    )
    for method in methods:
        name = method.name
        if name in failed:
            rows[name] = replace(rows[name], status="failed", why=failed[name])
        if name not in calls:
            continue
        metrics = []
        if name in prepared:
            metrics.append(Metric("prepare_ms", 1e3 * prepared[name], "ms", "down"))
        if not method.in_processes:
            before(name)
            last, memory = _looked_at(solves[name], case.trials[0])
            metrics.append(Metric("memory_mib", memory, "MiB", "down"))
            if case.once:
                calls[name][0].append(last)
        metrics = [*_times(case, method, first[name], calls[name]), *metrics]
        judged = case.judge([of_trial[-1].value for of_trial in calls[name]])
        rows[name] = replace(
            rows[name],
            calls=sum(map(len, calls[name])),
            metrics={m.key: m for m in [*judged.metrics, *method.metrics, *metrics]},
            samples={k: finite(v) for k, v in judged.samples.items()},
        )
    return list(rows.values())


def _described(case: Case, method: Method, row: Row) -> Row:
    return replace(
        row,
        parameters=method.parameters,
        data=case.data,
        trials=len(case.trials),
        reference="" if method.name == case.reference else case.reference,
        x=case.x,
        x_label=case.x_label,
    )


def _prepared(method: Method) -> tuple[Solve, float | None]:
    """What solves, and the seconds of a second preparation: the first may compile."""
    if method.prepare is None:
        assert method.solve is not None, f"{method.name}: nothing to call"
        return method.solve, None
    method.prepare()
    took = timing.timed(method.prepare)
    return took.value, took.cpu


def _looked_at(solve: Solve, trial: tuple) -> tuple[timing.Timed, float]:
    """A call, and the MiB it needs; nothing looks on while it runs."""
    calls: list[timing.Timed] = []
    memory = growth_mib(lambda: calls.append(timing.timed(lambda: solve(*trial))))
    return calls[0], memory


def _times(
    case: Case,
    method: Method,
    first: timing.Timed,
    calls: list[list[timing.Timed]],
) -> list[Metric]:
    """CPU and wall time of a call, the first call apart, and the rate."""
    every = [call for of_trial in calls for call in of_trial]
    wall = timing.quartiles([call.wall for call in every], 1e3)
    metrics = [
        Metric("wall_ms", wall[1], "ms", "down", None, (wall[0], wall[2])),
        Metric("first_s", first.wall, "s", "down"),
    ]
    if not method.in_processes:
        cpu = timing.quartiles([call.cpu for call in every], 1e3)
        metrics.insert(
            0, Metric("cpu_ms", cpu[1], "ms", "down", None, (cpu[0], cpu[2]))
        )
    if case.items:
        rates = [1e3 * case.items / x for x in wall]
        key, spread = f"{case.item}_per_s", (rates[2], rates[0])
        metrics.append(Metric(key, rates[1], "1/s", "up", None, spread))
    return metrics


def blank_row(mode: str, workload: str, case: str, run: str, threads: int):
    """Makes the row of a method before it is measured."""

    def row(method: Method) -> Row:
        key = Key(mode, workload, case, method.name)
        return Row(key, method.library, "ok", run=run, threads=threads)

    return row


def finite(values: list[float]) -> list[float]:
    """For `samples`: JSON has no infinities, and four digits will do."""
    return [float(f"{v:.4g}") for v in np.nan_to_num(values, nan=1e9, posinf=1e9)]
