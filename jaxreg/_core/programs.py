"""Programs kept as they were traced, so that the next process need not trace them.

Tracing and lowering are two thirds of a start whose programs are compiled. `jax.export`
writes what they give; JAX's own cache keeps what the compiler makes of it.
"""

import functools
from collections.abc import Callable
from importlib.util import find_spec
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax

from jaxreg._core.platforms import platform_of, traced_for
from jaxreg._core.program_room import make_room
from jaxreg._core.program_store import ProgramStore


P = ParamSpec("P")
Out = TypeVar("Out")


def kept_program(function: Callable[P, Out]) -> Callable[P, Out]:
    """`equinox.filter_jit`; after `jaxreg.cache()` its programs are kept on disk.

    Those of calls from outside of transformations, with arrays of one device and with
    methods of this package: of other code a key cannot tell when it changes.
    """
    traced = _as_it_is_traced(function)
    plain = eqx.filter_jit(traced)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Out:
        platform = platform_of(args, kwargs)
        if platform is not None:
            make_room()
        if _STORE is None or platform is None:
            return plain(platform, args, kwargs)
        program = _STORE.program(traced, platform, args, kwargs)
        if program is None:
            return plain(platform, args, kwargs)
        return program(args, kwargs)

    return call


def keep_programs(folder: Path | None) -> None:
    """Keeps programs there from now on; None: no longer.

    Needs `flatbuffers`, by which `jax.export` writes: without it nothing is kept.
    """
    global _STORE
    able = find_spec("flatbuffers") is not None
    _STORE = ProgramStore(folder) if folder is not None and able else None


def _as_it_is_traced(function: Callable[..., Out]) -> Callable[..., Out]:
    """For one platform, with products of matrices in full precision.

    Poses need all digits of float32; accelerators multiply with 10 bits unless told.
    """

    @functools.wraps(function)
    def traced(platform: str | None, args: Any, kwargs: Any) -> Out:
        with traced_for(platform), jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    # By `wraps` it has the function's names, and would have its arguments.
    own = (Parameter(x, Parameter.POSITIONAL_ONLY) for x in ("platform", "a", "b"))
    traced.__signature__ = Signature(list(own))  # pyright: ignore[reportAttributeAccessIssue]
    return traced


_STORE: ProgramStore | None = None
