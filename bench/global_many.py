"""Thousands of horse trials in one call of `register`: memory and throughput.

Each number of cores is a process of its own, pinned to them. Growth of memory is the
largest resident set during a call less that before it, with the trials in memory.
"""

import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import jax
import numpy as np

from bench.particle_data import horse
from bench.particle_horse import ours, shift_of_model
from bench.particle_run import outcome
from bench.timing import num_cores, timed
from jaxreg import register


NOISE = 0.25
_PAGE = os.sysconf("SC_PAGE_SIZE")


class PeakMemory:
    """Looks at the resident set of this process every 10 ms while a block runs."""

    def __enter__(self) -> "PeakMemory":
        """Starts looking."""
        self.before = self.peak = _resident()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stops."""
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._done.wait(0.01):
            self.peak = max(self.peak, _resident())


def _resident() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * _PAGE


def measure(task: tuple[set[int], int, np.ndarray]) -> dict:
    """In a process of its own: cores, number of trials, model."""
    cores, num, model = task
    # Before JAX starts its threads, as many as there are cores.
    os.sched_setaffinity(0, cores)
    trials = horse(num, NOISE, model)
    target = np.broadcast_to(trials.target, (num, *trials.target.shape))

    def call() -> tuple[np.ndarray, np.ndarray]:
        found = register(trials.source, target, ours(), key=jax.random.key(0))
        return np.asarray(found.T_target_source, float), np.asarray(found.status)

    jax.numpy.zeros(1, np.float32).block_until_ready()
    with PeakMemory() as memory:
        start = time.perf_counter()
        call()
        first = time.perf_counter() - start
        took = timed(call)
    T, status = took.value
    found = outcome(T, status, trials)
    right = (found.degrees <= trials.degrees) & (shift_of_model(found, trials) <= 5)
    return {
        "experiment": "many",
        "method": "register, 40 particles",
        "used_cores": len(cores),
        "trials": num,
        "right": int(right.sum()),
        "trials_per_s": num / took.wall,
        "first_call_s": first,
        "cpu_ms": 1000 * took.cpu / num,
        "growth_mib": (memory.peak - memory.before) / 2**20,
    }


def compare(num: int, model: np.ndarray) -> list[dict]:
    """Prints a row for one core and, where there are two, for two."""
    print(
        f"\n{num} horses in one call, Table 1's protocol, {100 * NOISE:.0f} % noise\n"
        f"{'cores':>5s}{'right':>12s}{'trials/s':>10s}{'CPU ms':>8s}"
        f"{'first call s':>14s}{'growth MiB':>12s}"
    )
    free = sorted(os.sched_getaffinity(0))
    rows = []
    for used in range(1, min(2, num_cores()) + 1):
        context = get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            task = (set(free[:used]), num, model)
            row = pool.submit(measure, task).result()
        rows.append(row)
        print(
            f"{row['used_cores']:5d}{row['right']:7d}/{num:<4d}{row['trials_per_s']:10.1f}"
            f"{row['cpu_ms']:8.2f}{row['first_call_s']:14.1f}{row['growth_mib']:12.0f}",
            flush=True,
        )
    return rows
