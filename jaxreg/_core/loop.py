"""The loop of every iterative method: init, step, terminate, and one driver.

    state = iteration.init(start)
    end = iterate(iteration, state, max_steps=50)       # or `step` by hand
    end.state, end.converged, end.status

As optimistix' `iterative_solve`: an iteration holds what does not change and decides
when the answer stands still; the driver bounds the steps and tells the one from the
other; the adjoint says how derivatives pass.
"""

import abc
from typing import Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxreg._core.adjoint import AbstractAdjoint, ImplicitAdjoint
from jaxreg._core.status import Status
from jaxreg._core.typing import StatusArray


@runtime_checkable
class Counted(Protocol):
    """A state of an iteration: a pytree of arrays that counts its steps."""

    @property
    def num_steps(self) -> Int[Array, ""]:
        """Steps taken since `init`."""
        ...


State = TypeVar("State", bound=Counted)
Start = TypeVar("Start")


class AbstractIteration(eqx.Module, Generic[Start, State]):
    """An algorithm as steps on a state; all that a step only reads is a field."""

    @abc.abstractmethod
    def init(self, start: Start) -> State:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, state: State) -> State:
        """One step: shapes and dtypes stay, `num_steps` grows by one."""

    @abc.abstractmethod
    def terminate(self, state: State) -> Bool[Array, ""]:
        """Whether the answer stands still, whatever the number of steps."""

    @abc.abstractmethod
    def fail(self, state: State) -> Bool[Array, ""]:
        """Whether further steps are of no use, as after a number that is not finite."""


class Ended(eqx.Module, Generic[State]):
    """Where an iteration ended.

    Attributes:
        state: the last one.
        converged: whether it terminated; else the steps ran out, or it failed.
    """

    state: State
    converged: Bool[Array, ""]

    @property
    def status(self) -> StatusArray:
        """CONVERGED or MAX_STEPS."""
        return status_of(self.converged)


def iterate(
    iteration: AbstractIteration[Start, State],
    state: State,
    *,
    max_steps: int,
    adjoint: AbstractAdjoint | None = None,
) -> Ended[State]:
    """Steps until the iteration terminates or fails, `max_steps` times at most.

    Args:
        iteration: what to run.
        state: of its `init`, or of a `step` taken before.
        max_steps: in all, those before included (static).
        adjoint: how derivatives pass, `ImplicitAdjoint()` by default.
    """

    def unfinished(state: State) -> Bool[Array, ""]:
        ended = iteration.terminate(state) | iteration.fail(state)
        return ~ended & (state.num_steps < max_steps)

    def step(state: State) -> State:
        return iteration.step(state)

    adjoint = ImplicitAdjoint() if adjoint is None else adjoint
    end = adjoint.while_loop(unfinished, step, state, max_steps)
    return Ended(end, iteration.terminate(end))


def status_of(converged: Bool[Array, "*b"]) -> Int[Array, "*b"]:
    """CONVERGED or MAX_STEPS."""
    status = jnp.where(converged, Status.CONVERGED, Status.MAX_STEPS)
    return status.astype(jnp.int32)
