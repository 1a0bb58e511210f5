"""Pairs that other processes register."""

import multiprocessing
import os
import signal
import tempfile
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxreg as jr
from jaxreg.datasets import sculpture_scans
from jaxreg.multiview import workers


# Of few programs that compile quickly: where pairs are registered is one thing, how is
# another.
METHOD = jr.MultiStart(num_starts=32, num_steps=10, num_modes=1, batch_size=16)
SCANS = [s.astype(np.float32) for s in sculpture_scans(5, points_per_scan=800)[0]]


def _solved(**told) -> tuple[jr.ReconstructionSolution, list[jr.RelativeMotions]]:
    pairs: list[jr.RelativeMotions] = []
    sol = jr.reconstruct(
        SCANS,
        key=jax.random.key(3),
        method=METHOD,
        averaging=jr.SpanningTree(),
        on_pairs=pairs.append,
        **told,
    )
    return sol, pairs


@pytest.fixture(scope="module")
def alone():
    return _solved()


class _Here(Executor):
    """Calls what is submitted, at once; from the second on it fails, if it is to."""

    def __init__(self, error: Exception | None = None) -> None:
        self.tasks, self.error = [], error

    def submit(self, fn, /, *args, **kwargs):
        self.tasks.append(args[0])
        future: Future = Future()
        if self.error is not None and len(self.tasks) > 1:
            future.set_exception(self.error)
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_processes_give_the_very_bits(alone):
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        sol, pairs = _solved(executor=pool)
    for one, other in zip(jax.tree.leaves(sol), jax.tree.leaves(alone[0]), strict=True):
        np.testing.assert_array_equal(one, other)
    told = [tuple(pair) for found in pairs for pair in found.pairs.tolist()]
    wanted = [tuple(pair) for found in alone[1] for pair in found.pairs.tolist()]
    assert sorted(told) == sorted(wanted)


def test_what_was_found_before_a_failure_leads_to_the_same_answer(alone):
    here, pairs = _Here(RuntimeError("out of order")), []
    with pytest.raises(RuntimeError, match="out of order"):
        jr.reconstruct(
            SCANS,
            key=jax.random.key(3),
            method=METHOD,
            averaging=jr.SpanningTree(),
            on_pairs=pairs.append,
            executor=here,
        )
    assert sum(len(found.pairs) for found in pairs) == 4
    assert not here.tasks[0].shared.exists()
    sol, more = _solved(previous=pairs[0], executor=_Here())
    np.testing.assert_array_equal(sol.T_world_i, alone[0].T_world_i)
    assert sum(len(found.pairs) for found in more) == 6


def _kill(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_process_is_an_error_and_no_hang(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(workers, "_registered", _kill)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        with pytest.raises(BrokenProcessPool):
            _solved(executor=pool)


def test_workers_of_another_version_or_without_the_files_are_refused():
    here = _Here()
    _solved(executor=here)
    task = here.tasks[0]
    with pytest.raises(RuntimeError, match="the caller jaxreg 0.0, jax 1: install"):
        workers._registered(task._replace(versions=("jaxreg 0.0", "jax 1")))
    workers._shared.cache_clear()
    with pytest.raises(RuntimeError, match="does not see .*TMPDIR"):
        workers._registered(task)
    assert not list(Path(tempfile.gettempdir()).glob(f"{task.shared.parent.name}*"))


def test_workers_without_the_package_are_refused_by_its_name():
    """As Dask tells it."""
    error = RuntimeError("Error during deserialization of the task graph.")
    error.__cause__ = ModuleNotFoundError("No module named 'jaxreg'", name="jaxreg")
    here = f"jaxreg {jr.__version__}, jax {jax.__version__}"
    with pytest.raises(workers.WorkerError, match=f"has no jaxreg: .* has, {here}"):
        _solved(executor=_Here(error))


def test_an_executor_is_wanted_and_not_under_jit():
    with pytest.raises(TypeError, match="executor: wanted a concurrent.futures.Exec"):
        workers.check_executor(3)
    traced = jax.jit(
        lambda x: jr.reconstruct([x, x], key=jax.random.key(0), executor=_Here())
    )
    with pytest.raises(ValueError, match="executor: pairs are chosen outside"):
        traced(SCANS[0])
