"""What every command shares: device, screen, clock, the compilation cache."""

import contextlib
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import jax
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

import jaxreg
from jaxreg._core import programs_ahead, programs_in_a_row
from jaxreg._core.typing import Progress as ProgressCall
from jaxreg.app.cli.options import Options, SearchOptions
from jaxreg.io.errors import InputError
from jaxreg.io.printable import printable


_HURRY = "jax_disable_most_optimizations"
_CACHE_TROUBLE = re.compile("Error (reading|writing) persistent compilation cache")


@contextlib.contextmanager
def computing(options: Options) -> Iterator[None]:
    """On the device and in the precision that are asked for.

    Raises:
        InputError: if there is no such device.
    """
    if options.device != "auto":
        _use_device(options.device)
    before = jax.config.values[_HURRY]
    # These end with the block; the device is the process's.
    try:
        with jax.enable_x64(options.precision == "float64"):
            yield
    finally:
        jax.config.update(_HURRY, before)


def compile_in_a_hurry() -> None:
    """Optimises programs less, up to the end of the command.

    For what computes for a second or less: a first call is over in two thirds to three
    quarters of the time, later ones take some tenths of a second more. An accelerator's
    programs are left as they are.
    """
    if jax.default_backend() == "cpu":
        jax.config.update(_HURRY, True)


def key_of(options: Options) -> jax.Array:
    """The key that the seed stands for."""
    if not 0 <= options.seed < 2**31:
        raise InputError(f"--seed {options.seed}: wanted a number from 0 to 2^31 - 1.")
    return jax.random.key(options.seed)


def method_of(options: SearchOptions) -> "jaxreg.ParticleFilter":
    """The search of that budget, knowing what is upright."""
    usual = jaxreg.ParticleFilter()
    least = 2 * usual.num_modes
    if not least <= options.budget <= 2**20:
        raise InputError(
            f"--budget {options.budget}: wanted a number from {least} to 2^20."
        )
    carried = min(usual.num_particles, options.budget)
    prior = jaxreg.PartialPose(up=(0, 0, 1)) if options.upright else None
    return jaxreg.ParticleFilter(
        num_prior=options.budget, num_particles=carried, prior=prior
    )


class _SafeConsole(Console):
    """Names of files cannot steer the terminal."""

    def print(self, *objects: Any, **options: Any) -> None:
        safe = (printable(x) if isinstance(x, str) else x for x in objects)
        super().print(*safe, **options)


class Session:
    """One run of a command: where it writes to, and how long its parts took."""

    def __init__(self, options: Options, command: str):
        self.options = options
        self.command = command
        self.times: dict[str, float] = {}
        self.console = _SafeConsole(
            quiet=options.quiet or options.json, highlight=False, markup=False
        )

    @contextlib.contextmanager
    def timed(self, part: str, computes: bool = False) -> Iterator[None]:
        """Adds the seconds of the block, those of programs apart if it `computes`."""
        start = time.perf_counter()
        yield
        total = time.perf_counter() - start
        if computes:
            for kind, seconds in _CLOCK.seconds(start).items():
                seconds = min(seconds, total)
                self.times[kind] = self.times.get(kind, 0.0) + seconds
                total -= seconds
        self.times[part] = self.times.get(part, 0.0) + total

    @contextlib.contextmanager
    def progress(self) -> Iterator[ProgressCall]:
        """A live display of stages; silent if quiet or if nobody watches."""
        with Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=28),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=self.options.quiet or not Console(stderr=True).is_terminal,
        ) as display:
            tasks: dict[str, TaskID] = {}

            def call(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = display.add_task(f"{stage:<24}", total=total)
                display.update(tasks[stage], completed=done, total=total)

            yield call


def _use_device(kind: str) -> None:
    before = jax.config.values["jax_platforms"]
    platforms = {"gpu": ("cuda", "rocm")}.get(kind, (kind,))
    for platform in platforms:
        jax.config.update("jax_platforms", platform)
        # JAX asserts that it knows a platform, where no plugin names it.
        with contextlib.suppress(RuntimeError, AssertionError):
            if jax.default_backend() == kind:
                return
    jax.config.update("jax_platforms", before)
    raise InputError(
        f"--device {kind}: JAX finds none here.\n"
        "Install JAX for it, or leave the option out."
    )


def keep_compiled_programs() -> None:
    """Turns on `jaxreg.cache`; says in a line on standard error where that is unsafe.

    Must be called before the first compilation.
    """
    warnings.showwarning = _told_once(warnings.showwarning)
    try:
        jaxreg.cache()
    except ValueError as err:
        sys.stderr.write(f"jaxreg: {err}\n")
    except OSError:  # no home, or nothing can be made there: it is done without
        pass


def _told_once(show: Callable[..., None]) -> Callable[..., None]:
    """Says in a line what JAX warns of for each program that it cannot read or keep."""
    told: list[str] = []

    def once(message: Warning | str, *others: Any, **named: Any) -> None:
        if not _CACHE_TROUBLE.match(str(message)):
            show(message, *others, **named)
        elif not told:
            told.append(str(message))
            sys.stderr.write(
                f"jaxreg: {jax.config.values['jax_compilation_cache_dir']}: programs "
                "kept there cannot be read, or no new ones kept; they are compiled "
                "each time. Remove the folder if that stays so.\n"
            )

    return once


class Clock:
    """Seconds in which JAX made programs: traced, loaded and compiled them.

    Tracing is what each start repeats, loading is from the folder of kept programs; of
    those that are loaded ahead what they were waited for.
    """

    _EVENTS: ClassVar = {
        "/jax/core/compile/jaxpr_trace_duration": "trace",
        "/jax/core/compile/jaxpr_to_mlir_module_duration": "trace",
        "/jax/compilation_cache/cache_retrieval_time_sec": "load",
        "/jax/core/compile/backend_compile_duration": "compile",
        programs_ahead.WAITED: "load",
        programs_in_a_row.WAITED: "compile",
    }

    def __init__(self) -> None:
        self._parts: list[tuple[float, float, str]] = []
        jax.monitoring.register_event_duration_secs_listener(self.hear)

    def hear(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """An event of JAX that has just ended."""
        thread = threading.current_thread().name
        if event not in self._EVENTS or thread == programs_ahead.THREAD:
            return
        kind, start = self._EVENTS[event], time.perf_counter() - duration_secs
        # What began within it is part of it.
        while self._parts and self._parts[-1][0] >= start:
            if self._parts.pop()[2] == "load" and kind == "compile":
                kind = "load"
        self._parts.append((start, duration_secs, kind))

    def seconds(self, since: float) -> dict[str, float]:
        """By kind, of what began since then; of kinds that took any."""
        out: dict[str, float] = {}
        for start, seconds, kind in self._parts:
            if start >= since:
                out[kind] = out.get(kind, 0.0) + seconds
        return {kind: out[kind] for kind in ("trace", "load", "compile") if kind in out}


_CLOCK = Clock()
