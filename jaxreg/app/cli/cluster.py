"""`--cluster`: the processes that register pairs."""

import contextlib
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor

from jaxreg.io.errors import InputError
from jaxreg.io.extras import require


# Seconds in which a scheduler has to answer.
_PATIENCE = 30


@contextlib.contextmanager
def executor_of(told: str | None) -> Iterator[Executor | None]:
    """Of `local:N`, so many processes, or of the address of a Dask scheduler.

    Raises:
        InputError: if it is neither, or nothing answers there.
        MissingExtraError: if Dask is needed and not installed.
        BrokenExecutor: instead of Dask's own where one of its workers was killed.
    """
    if told is None:
        yield None
    elif told.startswith("local:"):
        # Spawned: JAX has threads, which a fork would leave behind.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(_number(told), mp_context=context) as pool:
            yield pool
    else:
        distributed = require("distributed", "--cluster ADDRESS", "cluster")
        try:
            client = distributed.Client(told, timeout=_PATIENCE)
        except (OSError, ValueError) as err:
            raise InputError(
                f"--cluster {told}: no Dask scheduler answered within {_PATIENCE} s.\n"
                "Wanted local:N, or the address that `dask scheduler` prints, such as "
                "tcp://HOST:8786."
            ) from err
        with client:
            try:
                yield client.get_executor()
            except distributed.KilledWorker as err:  # after several tries
                raise BrokenExecutor(str(err)) from err


def _number(told: str) -> int:
    number = told.removeprefix("local:")
    if not (number.isdecimal() and 0 < int(number) <= 1024):
        raise InputError(f"--cluster {told}: wanted local:N with N from 1 to 1024.")
    return int(number)
