"""The loop around a solver that works on one tangent space.

It is started anew around what it found, until that changes nothing: so the answer
stays on the group, and not far from the middle of its tangent space.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxreg._core.loop import AbstractIteration
from jaxreg._core.solver import Lowered
from jaxreg._core.typing import Scalar


#: After so many starts, each would have moved the answer by another large turn.
MAX_STARTS = 5
#: A sum is known to so many units of rounding.
ROUNDING = 8


class Restarted(NamedTuple):
    """Where the solver was last started, or ended."""

    T: Array
    cost: Array
    better: Array  # whether the last start led to no higher cost
    still: Array  # whether it changed nothing, by the solver's tolerances and `limit`
    num_steps: Array  # starts
    taken: Array  # steps of the solver


class AbstractRestarts(AbstractIteration[Array, Restarted]):
    """Starts of a solver; what it finds is kept if the cost does not rise.

    Attributes:
        limit: a start that lowers the cost by at most this share of it is the last.
    """

    limit: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def cost(self, T: Array) -> Array:
        """What is to become small."""

    @abc.abstractmethod
    def lowered(self, T: Array) -> tuple[Array, Lowered]:
        """Where the solver ends that starts at `T`."""

    def init(self, start: Array) -> Restarted:
        """Not started yet."""
        none, no = jnp.asarray(0, jnp.int32), jnp.asarray(False)
        return Restarted(start, self.cost(start), ~no, no, none, none)

    def terminate(self, state: Restarted) -> Bool[Array, ""]:
        """Whether the last start changed nothing."""
        return state.still

    def fail(self, state: Restarted) -> Bool[Array, ""]:
        """Whether another start would lead to higher costs again."""
        return ~state.better

    def step(self, state: Restarted) -> Restarted:
        """One start."""
        s = state
        T, found = self.lowered(s.T)
        cost = self.cost(T)
        size = jnp.abs(s.cost)
        better = cost <= s.cost + ROUNDING * jnp.finfo(cost.dtype).eps * size
        return Restarted(
            T=jnp.where(better, T, s.T),
            cost=jnp.where(better, cost, s.cost),
            better=better,
            still=found.converged & better & (s.cost - cost <= self.limit * size),
            num_steps=s.num_steps + 1,
            taken=s.taken + found.num_steps,
        )
