"""Work on pairs in blocks of one size: one small program, on all cores.

Under `jit` all pairs are one block, padding and all.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int

from jaxreg._core.checks import is_concrete
from jaxreg._core.cores import num_cores
from jaxreg.batching.threads import map_in_threads


Tree = TypeVar("Tree")

#: Pairs of a block where each is work of milliseconds.
BLOCK = 64


def in_blocks(
    run: Callable[[Int[Array, "b 2"]], Tree],
    pairs: Int[Array, "p 2"],
    given: Any,
    size: int = BLOCK,
) -> Tree:
    """What `run` tells of all pairs, one row of its arrays a pair.

    Args:
        run: works on some pairs.
        pairs: those of a scan and itself are padding; outside of `jit` they come last,
            and nothing is worked out for them but one row that stands for all.
        given: arrays that `run` has beside; where they are traced, so is all.
        size: pairs of a block.
    """
    leaves = jax.tree.leaves((given, pairs))
    if not all(is_concrete(x) for x in leaves):
        return run(pairs)
    ids = np.asarray(pairs)
    real = int(np.sum(ids[:, 0] != ids[:, 1]))
    # At least one row of padding, for the rows that are left out.
    num_blocks = -(-(real + 1) // size)
    filled = np.zeros((num_blocks * size, 2), np.int32)
    filled[:real] = ids[:real]
    blocks = [jax.device_put(x) for x in filled.reshape(num_blocks, size, 2)]
    parts = map_in_threads(partial(_finished, run), blocks, num_cores())
    return _rows(list(parts), np.minimum(np.arange(len(ids)), real))


def _finished(run: Callable[[Array], Tree], block: Array) -> Tree:
    return jax.block_until_ready(run(block))


def _rows(parts: Sequence[Tree], rows: np.ndarray) -> Tree:
    """Some rows of all blocks."""

    def of(*x: Array) -> np.ndarray:
        return np.concatenate(list(map(np.asarray, x)))[rows]

    return jax.device_put(jax.tree.map(of, *parts))
