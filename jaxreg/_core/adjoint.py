"""How derivatives pass a loop, or do not.

The names are those of optimistix and diffrax.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, TypeVar

import equinox as eqx
import equinox.internal as eqxi
from jax import lax
from jaxtyping import Array

from jaxreg._core import control


State = TypeVar("State")
Tree = TypeVar("Tree")


@eqx.filter_custom_jvp
def refusing(out: Tree, by: object, told: str) -> Tree:
    """`out`, which raises a TypeError where it is differentiated through `by`."""
    return out


@refusing.def_jvp
def _refusing_jvp(primals: tuple, tangents: tuple) -> tuple:
    raise TypeError(primals[2])


class AbstractAdjoint(eqx.Module):
    """How a method is differentiated; the answer itself is the same."""

    described: ClassVar[str] = "an adjoint such as ImplicitAdjoint()"

    @abc.abstractmethod
    def inputs(self, tree: Tree) -> Tree:
        """What the loop depends on, with the derivatives that it is to see."""

    @abc.abstractmethod
    def while_loop(
        self,
        unfinished: Callable[[State], Array],
        body: Callable[[State], State],
        start: State,
        max_steps: int,
    ) -> State:
        """Repeats `body` while `unfinished`, `max_steps` times at most."""


class ImplicitAdjoint(AbstractAdjoint):
    """By the implicit function theorem at the end of the loop, not through its steps.

    Right where the loop has converged. Time and memory do not depend on the number of
    steps; forward and reverse mode.
    """

    def inputs(self, tree: Tree) -> Tree:
        """Held."""
        return lax.stop_gradient(tree)

    def while_loop(
        self,
        unfinished: Callable[[State], Array],
        body: Callable[[State], State],
        start: State,
        max_steps: int,
    ) -> State:
        """`lax.while_loop`; `unfinished` counts the steps."""
        return control.while_loop(unfinished, body, start)


class RecursiveCheckpointAdjoint(AbstractAdjoint):
    """Backwards through the steps that were taken, some of them computed again.

    Right also where few steps were taken on purpose. Memory grows with the root of
    `max_steps`, unless the number of `checkpoints` is given; reverse mode only.
    """

    checkpoints: int | None = eqx.field(default=None, static=True)

    def inputs(self, tree: Tree) -> Tree:
        """As they are."""
        return tree

    def while_loop(
        self,
        unfinished: Callable[[State], Array],
        body: Callable[[State], State],
        start: State,
        max_steps: int,
    ) -> State:
        """Binomial checkpointing (Stumm and Walther 2010)."""
        return eqxi.while_loop(
            unfinished,
            lambda state: control.varying(body(state)),
            control.varying(start),
            max_steps=max_steps,
            kind="checkpointed",
            checkpoints=self.checkpoints,
        )
