"""Telling the caller how far host code between compiled pieces has come."""

import jax

from jaxreg._core.checks import is_concrete
from jaxreg._core.typing import Progress


def tell(
    progress: Progress | None, stage: str, done: int, total: int, *arrays: object
) -> None:
    """Calls `progress`, if given, once the arrays are there; never under `jit`."""
    if progress is None:
        return
    leaves = jax.tree.leaves(arrays)
    if all(map(is_concrete, leaves)):
        jax.block_until_ready(leaves)
        progress(stage, done, total)
