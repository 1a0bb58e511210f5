"""What a CPU and an accelerator do in different ways.

A CPU wants blocks that fit its caches; an accelerator waits for each turn of a loop and
wants all at once.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from jaxreg._core import control
from jaxreg._core.checks import is_concrete


Out = TypeVar("Out")

# Rows from which on a branch of the program costs less than it saves.
_MANY = 4096
#: What the program is for that is traced; None if it is not known.
_PLATFORM: ContextVar[str | None] = ContextVar("platform", default=None)


def platform_of(*inputs: Any) -> str | None:
    """Where a computation with these arrays runs: "cpu", "gpu", ...; None if traced."""
    if (known := _PLATFORM.get()) is not None:
        return known
    arrays = [x for x in jax.tree.leaves(inputs) if isinstance(x, jax.Array)]
    if not all(map(is_concrete, arrays)):
        return None
    for x in arrays:
        if x.committed:
            return next(iter(x.devices())).platform
    return default_platform()


def default_platform() -> str:
    """Of the device that JAX puts arrays on unless told."""
    config: Any = jax.config  # its names are made as it runs
    device = config.jax_default_device
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


@contextmanager
def traced_for(platform: str | None) -> Iterator[None]:
    """What is traced inside is for that platform alone."""
    before = _PLATFORM.set(platform)
    try:
        yield
    finally:
        _PLATFORM.reset(before)


def by_platform(cpu: Callable[[], Out], accelerator: Callable[[], Out]) -> Out:
    """One of two ways to an answer, by the platform that it is computed on."""
    platform = _PLATFORM.get()
    if platform is None and control.inside_shard_map():
        platform = default_platform()  # two branches would be of two types
    if platform is None:
        return lax.platform_dependent(cpu=cpu, default=accelerator)
    return cpu() if platform == "cpu" else accelerator()


def once(
    function: Callable[..., Out],
    *operands: Array,
    true: Bool[Array, ""],
    least: int = _MANY,
) -> Out:
    """`function(*operands)` of many rows, written to memory before it is used.

    On a CPU, XLA computes it anew at each use instead: of products of 6 x 6 matrices
    with differences of gathered rows all six entries gather again, and the scatters of
    what comes out multiply again.

    Args:
        function: of arrays.
        operands: its arguments; the first has a row for each of the many.
        true: always so, but the compiler must not know.
        least: how many are many.
    """
    if len(operands[0]) < least:
        return function(*operands)

    def never(*operands: Any) -> Any:
        shapes = jax.eval_shape(function, *operands)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    return by_platform(
        lambda: control.cond(true, lambda *x: function(*x), never, *operands),
        lambda: function(*operands),
    )
