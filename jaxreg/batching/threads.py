"""Work for all cores: XLA on CPU runs a loop on one.

A pool of the standard library; JAX's own settings of a thread have to be carried.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax
import jax.numpy as jnp


_Item = TypeVar("_Item")
_Out = TypeVar("_Out")


def map_in_threads(
    run: Callable[[_Item], _Out], items: Sequence[_Item], num_threads: int
) -> Iterator[_Out]:
    """Results in order; on an interruption, items not begun are dropped.

    The first runs alone: it compiles the program that the threads then share.
    """
    x64 = jnp.result_type(float) == jnp.float64

    def carried(item: _Item) -> _Out:
        # Set by a context manager, it is not seen by other threads.
        with jax.enable_x64(x64):
            return run(item)

    yield run(items[0])
    with ThreadPoolExecutor(num_threads) as pool:
        try:
            yield from pool.map(carried, items[1:])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
