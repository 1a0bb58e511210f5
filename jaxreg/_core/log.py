"""Records for Python's `logging`, under the name `jaxreg`; nothing is shown by default.

logging.getLogger("jaxreg").setLevel(logging.INFO), with a handler, shows stages and
solutions. Only host code between compiled pieces speaks; under `jit` nothing does.
"""

import logging

import jax

from jaxreg._core.checks import is_concrete


LOGGER = logging.getLogger("jaxreg")
# Without a handler of its own Python would print warnings.
LOGGER.addHandler(logging.NullHandler())


def is_heard() -> bool:
    """Whether somebody asked for what is told in passing."""
    return LOGGER.isEnabledFor(logging.INFO)


def log_stage(stage: str, done: int, total: int) -> None:
    """A stage of a computation, as `progress` is called."""
    LOGGER.info("%s: %d of %d", stage, done, total)


def log_solution(name: str, solution: object) -> None:
    """What a call found, if it is known and somebody listens; waits for it then."""
    if is_heard() and all(map(is_concrete, jax.tree.leaves(solution))):
        LOGGER.info("%s: %r", name, solution)
