"""Telling the caller how far host code between compiled pieces has come."""

import jax

from jaxreg._core.checks import is_concrete
from jaxreg._core.log import is_heard, log_stage
from jaxreg._core.typing import Progress


def tell(
    progress: Progress | None, stage: str, done: int, total: int, *arrays: object
) -> None:
    """Calls `progress`, if given, once the arrays are there; never under `jit`.

    The log of the package hears it, too, if somebody listens.
    """
    if progress is None and not is_heard():
        return
    leaves = jax.tree.leaves(arrays)
    if all(map(is_concrete, leaves)):
        jax.block_until_ready(leaves)
        log_stage(stage, done, total)
        if progress is not None:
            progress(stage, done, total)
