"""Runs workloads, each in a process of its own, and keeps rows as they finish."""

import hashlib
import json
import os
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

from bench import records
from bench.peers import PEERS
from bench.records import Key, Row
from bench.timing import cpu_model, versions
from bench.workloads import WORKLOADS


#: Seconds after which a call that has not come back counts as failed.
LONGEST_CALL = 900
_PACKAGES = ("jaxreg", "jax", "jaxlib", "numpy", *PEERS)
_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


class Settings(NamedTuple):
    """What the command was asked for; `peers` None for all."""

    workloads: list[str]
    quick: bool
    peers: list[str] | None
    out: Path
    data: Path
    resume: bool
    longest_call: float = LONGEST_CALL

    @property
    def mode(self) -> str:
        """As in the keys of rows."""
        return "quick" if self.quick else "full"

    @property
    def path(self) -> Path:
        """Of the rows."""
        return self.out / "rows.jsonl"


def run(settings: Settings) -> records.Records:
    """Measures all that is asked for.

    Returns:
        All rows of the file, with those of earlier calls.
    """
    name = _begin(settings)
    free = sorted(os.sched_getaffinity(0))
    asked = [w for w in settings.workloads if WORKLOADS[w].quick or not settings.quick]
    for workload in settings.workloads:
        if workload not in asked:
            print(f"{workload}: not in --quick")
    if not settings.quick:
        for workload in asked:
            known = WORKLOADS[workload]
            _measure(
                settings, workload, name, free[:1] if known.cores == "one" else free
            )
        return records.read(settings.path)
    # As many at a time as there are cores: what is compared shares one process and
    # one core, so all of it is disturbed alike.
    idle: Queue[int] = Queue()
    for core in free:
        idle.put(core)

    def one(workload: str) -> None:
        core = idle.get()
        try:
            _measure(settings, workload, name, [core])
        finally:
            idle.put(core)

    with ThreadPoolExecutor(len(free)) as pool:
        # The longest are the last of the list.
        for done in [pool.submit(one, workload) for workload in reversed(asked)]:
            done.result()
    return records.read(settings.path)


def _begin(settings: Settings) -> str:
    """Writes the line that rows point to; its name."""
    line: dict[str, Any] = {
        "kind": "run",
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": _command(settings),
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(_memory_gib(), 1),
        "system": sys.platform,
        "versions": versions(*_PACKAGES),
    }
    line["run"] = hashlib.sha256(json.dumps(line).encode()).hexdigest()[:10]
    records.append(settings.path, json.dumps(line))
    return line["run"]


def _command(settings: Settings) -> str:
    """What repeats it; folders are the caller's own."""
    words = ["python", "-m", "bench"] + ["--quick"] * settings.quick
    if settings.workloads != list(WORKLOADS):
        words += ["--only", *settings.workloads]
    if settings.peers is not None:
        words += ["--peers", ",".join(settings.peers) or "none"]
    return shlex.join(words)


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _measure(
    settings: Settings, workload: str, run_name: str, cores: list[int]
) -> None:
    """Starts the process; once more without what crashed it, until it ends well."""
    started = time.perf_counter()
    task = {
        "workload": workload,
        "quick": settings.quick,
        "peers": settings.peers,
        "out": str(settings.out),
        "data": str(settings.data),
        "resume": settings.resume,
        "run": run_name,
        "cores": cores,
    }
    environment = os.environ | dict.fromkeys(_THREADS, str(len(cores)))
    environment["JAX_ENABLE_X64"] = "1" if WORKLOADS[workload].double else "0"
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # first calls compile
    command = [sys.executable, "-m", "bench.worker", json.dumps(task)]
    crashed: set[tuple[str, str]] = set()
    running = settings.out / f"running-{workload}.json"
    while why := _process(command, environment, running, settings.longest_call):
        state = _state(running)
        at = (state["case"], state["method"])
        if at in crashed:  # it is not the method
            break
        crashed.add(at)
        key = Key(settings.mode, workload, *at)
        row = Row(key, state["library"], "failed", why, run=run_name)
        records.append(settings.path, records.to_line(row))
        print(f"{workload}: {at[0]}: {at[1]}: {why}", flush=True)
    print(f"{workload}: {time.perf_counter() - started:.0f} s", flush=True)


def _process(
    command: list[str], environment: dict, running: Path, longest_call: float
) -> str:
    """Why the process of a workload did not end well, or ''."""
    running.unlink(missing_ok=True)
    with subprocess.Popen(command, env=environment) as process:
        try:
            while True:
                try:
                    code = process.wait(1)
                    break
                except subprocess.TimeoutExpired:
                    if _age(running) > longest_call:
                        process.kill()
                        return f"no answer in {longest_call:.0f} s"
        except BaseException:
            process.kill()
            raise
    return "" if code == 0 else f"its process ended with code {code}"


def _age(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _state(running: Path) -> dict[str, str]:
    """What was being called; taken away, so that it is told once."""
    try:
        state = json.loads(running.read_text())
        running.unlink()
        return state
    except (OSError, ValueError):
        return {"case": "all", "method": "-", "library": "jaxreg"}
