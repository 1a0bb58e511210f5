"""Programs kept as they were traced, so that the next process need not trace them.

Tracing and lowering are two thirds of a start whose programs are compiled. `jax.export`
writes what they give; JAX's own cache keeps what the compiler makes of it.
"""

import functools
from collections.abc import Callable
from importlib.util import find_spec
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax

from jaxreg._core.platforms import platform_of, traced_for
from jaxreg._core.program_call import Call
from jaxreg._core.program_room import make_room, num_drops
from jaxreg._core.program_store import ProgramStore


P = ParamSpec("P")
Out = TypeVar("Out")


def kept_program(function: Callable[P, Out]) -> Callable[P, Out]:
    """`equinox.filter_jit`; after `jaxreg.cache()` its programs are kept on disk.

    Those of calls from outside of transformations, with arrays of one device and with
    methods of this package: of other code a key cannot tell when it changes.
    """
    program = KeptProgram(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Out:
        return program(*args, **kwargs)

    return call


class KeptProgram(Generic[P, Out]):
    """What `kept_program` calls."""

    def __init__(self, function: Callable[P, Out]):
        self._traced = _as_it_is_traced(function)
        self._plain: Any = eqx.filter_jit(self._traced)
        # Of each, how often all programs had been dropped by then.
        self._begun: dict[Any, int] = {}

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> Out:
        platform = platform_of(args, kwargs)
        if platform is not None:
            make_room()
        if _STORE is None or platform is None:
            return self._plain(platform, args, kwargs)
        call = Call.of(self._traced, platform, args, kwargs)
        program = None if call is None else _STORE.program(call)
        if program is None:
            return self._plain(platform, args, kwargs)
        return program(args, kwargs)

    def begin(self, *args: P.args, **kwargs: P.kwargs) -> "Begun | None":
        """Traces the program of a call; None if it was, or is kept, or cannot be."""
        platform = platform_of(args, kwargs)
        if platform is None:
            return None
        call = Call.of(self._traced, platform, args, kwargs)
        if call is None or self._begun.get(call.key) == num_drops():
            return None
        self._begun[call.key] = num_drops()
        program = None if _STORE is None else _STORE.program(call)
        if program is not None:
            return None if program.kept else Begun(program.lowered(), program.gives)
        lowered = self._plain.lower(platform, args, kwargs)
        gives = eqx.filter_eval_shape(self._plain, platform, args, kwargs)
        return Begun(lowered, gives)


class Begun(NamedTuple):
    """A program that was traced, but not compiled.

    Attributes:
        lowered: to be compiled, in any thread; a call then finds it compiled.
        gives: its answer, with shapes for arrays.
    """

    lowered: Any
    gives: Any


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
