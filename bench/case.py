"""What a workload hands over to be measured: cases, and methods that solve them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from bench.records import Metric


#: Takes the arguments of a trial, returns its answer in NumPy arrays.
Solve = Callable[..., Any]


class Options(NamedTuple):
    """What a workload is told: small generated cases only, and where data lie."""

    quick: bool
    data: Path


@dataclass(frozen=True)
class Method:
    """One way to solve a case.

    Attributes:
        name: in its row.
        library: the package that is measured, as in `bench.peers.PEERS`, or "jaxreg";
            "published" for figures of a paper, which are `metrics` and not measured.
        parameters: written out for the reader.
        solve: called on every trial.
        prepare: where something is built once for all trials, what returns `solve`;
            its time is a metric of its own.
        in_processes: whether `solve` works in other processes, whose CPU time and
            memory are not those of this one.
        on_accelerator: whether `solve` is JAX on arrays of its own and gets a second
            row where there is an accelerator.
        metrics: what is known of it without a call.
    """

    name: str
    library: str
    parameters: str
    solve: Solve | None = None
    prepare: Callable[[], Solve] | None = None
    in_processes: bool = False
    on_accelerator: bool = False
    metrics: Sequence[Metric] = ()


class Judged(NamedTuple):
    """Accuracy over all trials, and values of single trials for the plots."""

    metrics: list[Metric]
    samples: dict[str, list[float]] = {}


@dataclass(frozen=True)
class Case:
    """Trials that all methods solve.

    Attributes:
        name: in its rows; with `x`, of `x_label`, where cases form a series.
        data: what the trials are made of, as told to the reader.
        methods: what solves them.
        trials: arguments of `solve`.
        judge: accuracy of the answers, one for each trial.
        repeats: timed calls of each method on each trial; five calls at the least.
        long: whether a call takes up to minutes: three are enough.
        once: whether it takes many: one after the first is enough, whose memory is
            looked at.
        reference: the method that others are compared with in time.
        items: things that a call handles, named `item`, for a rate; 0 for none.
        warm_up: whether trials differ in shape, so that each compiles.
    """

    name: str
    data: str
    methods: Sequence[Method]
    trials: Sequence[tuple]
    judge: Callable[[list[Any]], Judged]
    repeats: int = 1
    reference: str = ""
    items: int = 0
    item: str = ""
    warm_up: bool = False
    long: bool = False
    once: bool = False
    x: float | None = None
    x_label: str = ""

    def __post_init__(self) -> None:
        least = 1 if self.once else 3 if self.long else 5
        if self.repeats * len(self.trials) < least:
            raise ValueError(f"{self.name}: fewer than {least} calls of each method")
