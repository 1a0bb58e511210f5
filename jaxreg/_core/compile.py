"""`compiled`: jit for programs of many small kernels, quicker to compile on CPU.

XLA's newer generator of CPU kernels takes longer over each kernel than the older one,
with which first calls of `register` and `average` take two thirds of the time; later
ones of `register` take as long, of `average` a quarter longer. The older one takes
minutes over a chain of `where` in which each condition and each value use the last one:
write such a chain as a minimum.
"""

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.extend.core import get_opaque_trace_state

from jaxreg._core.checks import is_concrete


P = ParamSpec("P")
T = TypeVar("T")

_QUICKER = {"xla_cpu_use_fusion_emitters": False}
_EAGER = get_opaque_trace_state()


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """`eqx.filter_jit`, with XLA's quicker kernel generator where nothing is traced.

    Inside a caller's `jit`, `vmap` or `grad`, and on other devices, it is plain
    `eqx.filter_jit`: JAX takes compiler options at the outermost level alone.
    """
    plain = eqx.filter_jit(function)
    options: dict[str, Any] = {"compiler_options": _QUICKER}
    quicker = eqx.filter_jit(function, **options)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        leaves = jax.tree.leaves((args, kwargs))
        if get_opaque_trace_state() != _EAGER or not all(map(is_concrete, leaves)):
            return plain(*args, **kwargs)
        with _no_collection():
            return (quicker if _known() else plain)(*args, **kwargs)

    return call


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Without garbage collection: none of the many objects that tracing makes is lost.

    Looking through them again and again takes up to a tenth of a first call.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.cache
def _known() -> bool:
    """Whether this version of XLA has the option; it may go."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda: 0, compiler_options=_QUICKER)()
    except jax.errors.JaxRuntimeError:
        return False
    return True
