"""CPU and wall time of calls, and the state of the machine they ran on."""

import importlib.metadata
import json
import platform
import time
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Timed(NamedTuple):
    """What a call gave and what it cost, in seconds."""

    value: Any
    cpu: float
    wall: float


def timed(fn: Callable[[], Any]) -> Timed:
    """Calls once. CPU time is that of all threads of this process."""
    cpu, wall = time.process_time(), time.perf_counter()
    value = fn()
    return Timed(value, time.process_time() - cpu, time.perf_counter() - wall)


def in_turn(
    methods: dict[str, Callable[..., Any]],
    cases: Sequence[tuple],
    repeats: int,
    *,
    warm_up: bool = False,
    before: Callable[[str], None] = lambda name: None,
) -> tuple[dict[str, Timed], dict[str, list[list[Timed]]], dict[str, str]]:
    """Calls all methods on each case in an order that changes.

    Args:
        methods: what to call, by name.
        cases: arguments of the calls.
        repeats: calls of each method on each case.
        warm_up: whether each method is called once more on each case before those, as
            where cases differ in shape and compile.
        before: told the name of the method before each of its calls.

    Returns:
        The first call of each method, on the first case and apart from the others; its
        calls `[case][repeat]`; and what went wrong, for the methods that failed.
    """
    first: dict[str, Timed] = {}
    calls: dict[str, list[list[Timed]]] = {}
    failed: dict[str, str] = {}

    def attempt(name: str, case: tuple) -> Timed | None:
        before(name)
        try:
            return timed(lambda: methods[name](*case))
        except Exception as err:  # another version of a peer, or out of memory
            failed[name] = str(err) or type(err).__name__
            calls.pop(name, None)
            return None

    for name in methods:
        call = attempt(name, cases[0])
        if call is not None:
            first[name], calls[name] = call, [[] for _ in cases]
    order = np.random.default_rng(0)
    for at, case in enumerate(cases):
        for name in list(calls) if warm_up and at else []:
            attempt(name, case)
        for _ in range(repeats):
            for name in order.permutation(list(calls)).tolist():
                call = attempt(name, case)
                if call is not None:
                    calls[name][at].append(call)
    return first, calls, failed


def quartiles(values: list[float], scale: float = 1.0) -> list[float]:
    """Lower quartile, median and upper quartile."""
    return [float(scale * x) for x in np.percentile(values, (25, 50, 75))]


def versions(*packages: str) -> dict[str, str]:
    """Installed versions, with that of Python; 'not installed' where missing."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def cpu_model() -> str:
    """The processor's name where the system tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [x.split(":", 1)[1] for x in file if x.startswith("model name")]
        return names[0].strip()
    except (OSError, IndexError):
        return platform.processor() or platform.machine()


def keep(rows: list[dict], common: dict, path: Path | None) -> None:
    """Adds rows to a file of JSON lines."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row | common) + "\n" for row in rows)


def within(seconds: float, function: Callable[..., Any], *args: Any) -> Any:
    """What a call gives in a process of its own, which is ended after so long."""
    with get_context("spawn").Pool(1) as pool:
        answer = pool.apply_async(function, args)
        answer.wait(seconds)
        if not answer.ready():
            raise TimeoutError(f"no answer in {seconds:g} s")
        return answer.get()
