"""ICP stepped by hand."""

import equinox as eqx
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error

import jaxreg as jr


def test_steps_by_hand_lead_where_the_method_does():
    truth = motion(1, 2, angle=0.3, shift=200.0)
    target = 50 * blob(64, 2) + np.float32(300)
    source = move(np.linalg.inv(truth), target)
    # A turn by 0.1 about the middle of the target.
    turn = motion(2, 2, angle=0.1)
    turn[:2, 2] = target.mean(0) - turn[:2, :2] @ target.mean(0)
    guess = turn @ truth
    method = jr.ICP(jr.PointToPoint(), max_correspondence_distance=40.0)
    descending, state = eqx.filter_jit(method.iteration)(source, target, guess)
    step = eqx.filter_jit(descending.step)
    frames = descending.problem.frames
    assert frames is not None
    np.testing.assert_allclose(frames.leave(state.T), guess, atol=1e-2)
    while not descending.terminate(state):
        state = step(state)
    sol = jr.register(source, target, method, init=guess)
    assert int(state.num_steps) == int(sol.num_steps)
    np.testing.assert_allclose(frames.leave(state.T), sol.T_target_source, atol=0.02)
    assert pose_error(frames.leave(state.T), truth)[0] < 1e-3
    with pytest.raises(ValueError, match="source: wanted shape"):
        method.iteration(source[None], target[None])
