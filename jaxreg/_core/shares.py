"""Rows of one problem over the devices of an axis: each computes a share of them.

Whoever spreads says so around what is traced; what costs time for each row is wrapped:

    with sharing("particle"):
        found = shared(jax.vmap(measure), T)  # all rows, on every device

What is not wrapped each device computes for itself, from the same numbers. Loops and
branches around what is wrapped go by what was gathered: were one device to leave a loop
that others stay in, they would wait for it for ever.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


Tree = TypeVar("Tree")
Out = TypeVar("Out")

#: The axis of `shard_map` that shares rows, while a function is traced; None: no axis.
_AXIS: ContextVar[str | None] = ContextVar("axis", default=None)


@contextmanager
def sharing(axis: str | None) -> Iterator[None]:
    """The devices of the axis share the rows of what is traced inside.

    All of them hold the same numbers, and types are not checked (`check_vma=False`).
    """
    before = _AXIS.set(axis)
    try:
        yield
    finally:
        _AXIS.reset(before)


def shared(function: Callable[[Tree], Out], rows: Tree) -> Out:
    """`function(rows)`; where rows are shared, each device's own, then gathered.

    Args:
        function: of a tree whose leaves have any number of rows, to one likewise, each
            row for itself.
        rows: arrays of one number of rows.
    """
    axis = _AXIS.get()
    if axis is None:
        return function(rows)
    num, parts = len(jax.tree.leaves(rows)[0]), lax.axis_size(axis)
    # Every so many: the first of modes are in use, the last cost nothing. Where they do
    # not come out even, the last row is computed more than once.
    own = jnp.arange(-(-num // parts)) * parts + lax.axis_index(axis)
    own = jnp.minimum(own, num - 1)
    with sharing(None):  # a share is not shared once more
        found = function(jax.tree.map(lambda x: x[own], rows))

    def joined(x: Array) -> Array:
        every = lax.all_gather(x, axis, axis=1)
        return every.reshape(-1, *x.shape[1:])[:num]

    return jax.tree.map(joined, found)
