"""Runs workloads, each in a process of its own, and keeps rows as they finish."""

import contextlib
import hashlib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from queue import Queue
from threading import Event
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
    accelerator: bool = False
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
    name, stop = _begin(settings), Event()
    free = sorted(os.sched_getaffinity(0))
    asked = [w for w in settings.workloads if WORKLOADS[w].quick or not settings.quick]
    for workload in settings.workloads:
        if workload not in asked:
            print(f"{workload}: not in --quick")
    if not settings.quick:
        for workload in asked:
            cores = free[:1] if WORKLOADS[workload].cores == "one" else free
            _measure(settings, workload, name, cores, stop)
        return records.read(settings.path)
    # As many at a time as there are cores: what is compared shares one process and
    # one core, so all of it is disturbed alike.
    idle: Queue[int] = Queue()
    for core in free:
        idle.put(core)

    def one(workload: str) -> None:
        core = idle.get()
        try:
            _measure(settings, workload, name, [core], stop)
        finally:
            idle.put(core)

    pool = ThreadPoolExecutor(len(free))
    try:
        # The longest are the last of the list.
        for done in [pool.submit(one, workload) for workload in reversed(asked)]:
            done.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
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
    words += ["--accelerator"] * settings.accelerator
    if settings.workloads != list(WORKLOADS):
        words += ["--only", *settings.workloads]
    if settings.peers is not None:
        words += ["--peers", ",".join(settings.peers) or "none"]
    return shlex.join(words)


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _measure(
    settings: Settings, workload: str, run_name: str, cores: list[int], stop: Event
) -> None:
    """Starts the process; once more without what crashed it, until it ends well."""
    known = WORKLOADS[workload]
    print(f"{workload}: {known.title} ...", flush=True)
    started = time.perf_counter()
    environment = os.environ | dict.fromkeys(_THREADS, str(len(cores)))
    environment["JAX_ENABLE_X64"] = "1" if known.double else "0"
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # first calls compile
    if known.devices:
        flag = f"--xla_force_host_platform_device_count={len(cores)}"
        environment["XLA_FLAGS"] = f"{environment.get('XLA_FLAGS', '')} {flag}"
    crashed: set[tuple[str, str]] = set()
    # A process that is killed leaves its temporary files; ours go with the folder.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        environment["TMPDIR"] = scratch
        running = Path(scratch, "running.json")
        task = {
            "workload": workload,
            "quick": settings.quick,
            "peers": settings.peers,
            "out": str(settings.out),
            "data": str(settings.data),
            "resume": settings.resume,
            "run": run_name,
            "cores": cores,
            "accelerator": settings.accelerator,
            "running": str(running),
        }
        command = [sys.executable, "-m", "bench.worker", json.dumps(task)]
        longest = settings.longest_call
        while why := _process(command, environment, running, longest, stop):
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
    command: list[str],
    environment: dict,
    running: Path,
    longest_call: float,
    stop: Event,
) -> str:
    """Why the process of a workload did not end well, or ''.

    Raises:
        KeyboardInterrupt: if told to stop.
    """
    running.unlink(missing_ok=True)
    # A group of its own: Ctrl-C comes here alone, and its children end with it.
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, process_group=0
    )
    try:
        while not stop.is_set():
            try:
                code = process.wait(1)
                return "" if code == 0 else f"its process ended with code {code}"
            except subprocess.TimeoutExpired:
                if _age(running) > longest_call:
                    return f"no answer in {longest_call:.0f} s"
        raise KeyboardInterrupt
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


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
