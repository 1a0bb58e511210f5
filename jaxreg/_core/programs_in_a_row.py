"""Two programs, one after the other, which are compiled side by side.

XLA compiles one program on little more than one core: `jaxreg register` takes 25 s for
33 on two, `jaxreg average` of sphere2500 18 for 22. Where they are kept,
`ProgramsAhead` loads the second beside the first: 4.8 s for 6.4, 3.8 for 4.8.
"""

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.program_room import has_room
from jaxreg._core.program_store import is_committed
from jaxreg._core.programs import KeptProgram
from jaxreg._core.programs_ahead import THREAD


P = ParamSpec("P")
Between = TypeVar("Between")
Out = TypeVar("Out")

#: An event of `jax.monitoring`: the seconds that the main thread waited for the other.
WAITED = "/jaxreg/programs_in_a_row_waited_for"


def kept_programs(
    first: Callable[P, Between], second: Callable[[Between], Out]
) -> Callable[P, Out]:
    """`second(first(...))`, each a `kept_program`."""
    one, other = KeptProgram(first), KeptProgram(second)

    @functools.wraps(first)
    def call(*args: P.args, **kwargs: P.kwargs) -> Out:
        begun = one.begin(*args, **kwargs)
        if begun is not None and has_room() and not _for_good((args, kwargs)):
            with _compiled_beside(begun.lowered), contextlib.suppress(_NoStandIn):
                following = other.begin(jax.tree.map(_stand_in, begun.gives))
                if following is not None:
                    following.lowered.compile()
        return other(one(*args, **kwargs))

    return call


def _for_good(given: Any) -> bool:
    """Whether on a device for good: the second program, too, is for that one alone."""
    return any(map(is_committed, jax.tree.leaves(given)))


@contextlib.contextmanager
def _compiled_beside(lowered: Any) -> Iterator[None]:
    def compile() -> None:
        with contextlib.suppress(Exception):  # who calls it finds out what is wrong
            lowered.compile()

    # No daemon: Python must not be taken down while XLA works in a thread.
    thread = threading.Thread(target=compile, name=THREAD)
    thread.start()
    try:
        yield
    finally:
        start = time.perf_counter()
        thread.join()
        waited = time.perf_counter() - start
        jax.monitoring.record_event_duration_secs(WAITED, waited)


class _NoStandIn(Exception):
    """For keys, which NumPy does not know."""


def _stand_in(x: Any) -> Any:
    """Zeros in place of what the first program will give; compiles nothing."""
    if not isinstance(x, jax.ShapeDtypeStruct):
        return x
    if jnp.issubdtype(x.dtype, jax.dtypes.extended):
        raise _NoStandIn
    return jax.device_put(np.zeros(x.shape, x.dtype))
