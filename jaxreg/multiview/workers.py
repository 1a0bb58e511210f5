"""Pairs of scans registered by the processes of an executor.

`concurrent.futures` hands out the tasks, as do engines that follow it (Dask's
`Client.get_executor()`). Prepared scans lie in a file that every process maps.
"""

import functools
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.cache import cache
from jaxreg._core.typing import Key
from jaxreg.multiview.mapped_file import read_tree, write_tree
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions, relative_motions
from jaxreg.registrar import AbstractRegistrar


def check_executor(executor: object) -> None:
    """Requires an executor, or None."""
    if executor is not None and not isinstance(executor, Executor):
        raise TypeError(
            "executor: wanted a concurrent.futures.Executor, or None, found "
            f"{type(executor).__name__}."
        )


class WorkerError(RuntimeError):
    """A worker without this package, of other versions, or that sees no files."""


class _Task(NamedTuple):
    """Some pairs, and what a process needs to register them to the same bits."""

    pairs: np.ndarray
    shared: Path  # the method, the scans and the key
    kind_of_key: str
    programs: str | None  # folder of compiled ones
    x64: bool
    versions: tuple[str, ...]


class Workers:
    """Registers batches of pairs elsewhere; leave it as a context to drop its file.

    Args:
        executor: whose processes see the folder for temporary files (TMPDIR).
        method, scans, key: as in `relative_motions`.
    """

    def __init__(
        self,
        executor: Executor,
        method: AbstractRegistrar,
        scans: PreparedScans,
        key: Key,
    ) -> None:
        self._executor = executor
        host = jax.tree.map(np.asarray, (method, scans, jax.random.key_data(key)))
        # Where a mapped file cannot be removed it stays behind.
        self._folder = tempfile.TemporaryDirectory(
            prefix="jaxreg-scans-", ignore_cleanup_errors=True
        )
        self._shared = Path(self._folder.name) / "scans"
        with self._shared.open("wb") as file:
            write_tree(file, host)
        self._kind_of_key = str(jax.random.key_impl(key))

    def __enter__(self) -> "Workers":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._folder.cleanup()

    def registered(
        self, batches: Sequence[np.ndarray]
    ) -> Iterator[tuple[int, RelativeMotions]]:
        """The motions of each batch and its number, as they come.

        Where one fails, those that are under way come first; then it is raised.
        """
        waiting: dict[Future[RelativeMotions], int] = {}
        failed: BaseException | None = None
        try:
            for number, pairs in enumerate(batches):
                task = self._task(pairs)
                waiting[self._executor.submit(_registered, task)] = number
            for done in as_completed(waiting):
                if done.cancelled():
                    continue
                if (error := done.exception()) is None:
                    yield waiting[done], jax.device_put(done.result())
                elif failed is None:
                    failed = error
                    _cancel(waiting)
        finally:
            _cancel(waiting)
        if failed is not None:
            missing = _missing_module(failed)
            if missing is None:
                raise failed
            raise WorkerError(
                f"The scheduler or a worker has no {missing}: install there what the "
                f"caller has, {', '.join(_versions())}."
            ) from failed

    def _task(self, pairs: np.ndarray) -> _Task:
        config: Any = jax.config  # its names are made as it runs
        return _Task(
            pairs,
            self._shared,
            self._kind_of_key,
            config.jax_compilation_cache_dir,
            jnp.result_type(float) == jnp.float64,
            _versions(),
        )


def _cancel(waiting: Iterable[Future[RelativeMotions]]) -> None:
    for future in waiting:
        future.cancel()


def _missing_module(error: BaseException | None) -> str | None:
    """What could not be imported elsewhere, if that is why something failed."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError):
            return error.name or str(error)
        error = error.__cause__
    return None


@functools.cache
def _versions() -> tuple[str, ...]:
    """Of what the bits of an answer depend on."""
    own = sys.modules["jaxreg"].__version__  # it imports this file
    others = (f"{name} {metadata.version(name)}" for name in ("jax", "jaxlib"))
    return f"jaxreg {own}", *others


def _registered(task: _Task) -> RelativeMotions:
    """What a worker does.

    Raises:
        WorkerError: if it has other versions, or does not see the caller's files.
    """
    here = _versions()
    if here != task.versions:
        raise WorkerError(
            f"A worker has {', '.join(here)}, the caller {', '.join(task.versions)}: "
            "install the same on both."
        )
    config: Any = jax.config
    if task.programs is not None and config.jax_compilation_cache_dir is None:
        cache(task.programs)
    with jax.enable_x64(task.x64):
        try:
            method, scans, key = _shared(task.shared, task.kind_of_key)
        except FileNotFoundError as err:
            raise WorkerError(
                f"A worker does not see {task.shared}: let TMPDIR of the caller name a "
                "folder that all machines share."
            ) from err
        some, rows = scans.of_pairs(task.pairs)
        found = relative_motions(method, some, rows, key)
        return jax.tree.map(np.asarray, found)


@functools.lru_cache(maxsize=1)
def _shared(
    path: Path, kind_of_key: str
) -> tuple[AbstractRegistrar, PreparedScans, Key]:
    with path.open("rb") as file:
        method, scans, bits = jax.device_put(read_tree(file))
    return method, scans, jax.random.wrap_key_data(bits, impl=kind_of_key)
