"""The driver of every iterative method, on Newton's method for a square root."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, Int

from jaxreg import ImplicitAdjoint, RecursiveCheckpointAdjoint, Status
from jaxreg._core.loop import AbstractIteration, iterate


class _State(NamedTuple):
    x: Float[Array, ""]
    change: Float[Array, ""]
    num_steps: Int[Array, ""]


class _Root(AbstractIteration[Array, _State]):
    square: Float[Array, ""]
    tolerance: float = 1e-4

    def init(self, start: Array) -> _State:
        return _State(start, jnp.full_like(start, jnp.inf), jnp.asarray(0, jnp.int32))

    def step(self, state: _State) -> _State:
        x = (state.x + self.square / state.x) / 2
        return _State(x, jnp.abs(x - state.x), state.num_steps + 1)

    def terminate(self, state: _State) -> Bool[Array, ""]:
        return state.change < self.tolerance

    def fail(self, state: _State) -> Bool[Array, ""]:
        return jnp.isnan(state.x)


def _run(square, start=1.0, max_steps=20, adjoint=None):
    root = _Root(jnp.asarray(square, jnp.float32))
    begin = root.init(jnp.asarray(start, jnp.float32))
    return iterate(root, begin, max_steps=max_steps, adjoint=adjoint)


def test_the_driver_takes_the_steps_that_a_hand_takes():
    root = _Root(jnp.asarray(2.0, jnp.float32))
    state = begin = root.init(jnp.asarray(1.0, jnp.float32))
    while not root.terminate(state):
        state = root.step(state)
    end = iterate(root, begin, max_steps=20)
    np.testing.assert_allclose(end.state, state, rtol=1e-6)
    assert float(end.state.x) == pytest.approx(np.sqrt(2), rel=1e-6)
    # Taken up again it goes on to the same end, by as many steps in all.
    again = iterate(root, root.step(begin), max_steps=20)
    np.testing.assert_allclose(again.state, end.state, rtol=1e-6)


def test_convergence_is_told_apart_from_the_end_of_the_steps_and_from_failure():
    squares, starts = jnp.array([2.0, 1e30, jnp.nan]), jnp.ones(3)
    end = jax.vmap(lambda s, x: _run(s, x))(squares, starts)
    np.testing.assert_array_equal(end.converged, [True, False, False])
    np.testing.assert_array_equal(
        end.status, [Status.CONVERGED, Status.MAX_STEPS, Status.MAX_STEPS]
    )
    assert end.status.dtype == jnp.int32
    # More steps do not help what is not a number.
    assert end.state.num_steps[1:].tolist() == [20, 1]
    # Whoever stands still at the last step has converged.
    needed = int(end.state.num_steps[0])
    assert bool(_run(2.0, max_steps=needed).converged)
    assert not bool(_run(2.0, max_steps=needed - 1).converged)


def test_the_adjoint_says_how_derivatives_pass():
    def root(square, adjoint):
        return _run(square, adjoint=adjoint).state.x

    through = jax.grad(root)(2.0, RecursiveCheckpointAdjoint())
    assert float(through) == pytest.approx(0.5 / np.sqrt(2), rel=1e-4)
    # Forward through the steps; a method attaches its implicit derivatives.
    tangent = jax.jvp(lambda s: root(s, ImplicitAdjoint()), (2.0,), (1.0,))[1]
    assert float(tangent) == pytest.approx(0.5 / np.sqrt(2), rel=1e-4)
