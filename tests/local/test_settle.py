"""Steps that creep are followed to their end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.geometry import lie
from jaxreg.local import decoupled_error, settled, turn_and_shift


END = jnp.asarray([0.2, -0.1, 0.3, 0.02, 0.03, -0.01])
T_END = turn_and_shift(jnp.eye(4), END)


def _steps(share, tolerance, most=200, least=1):
    """Where steps end that leave this share of the way, and how many there were."""
    shares = jnp.broadcast_to(jnp.asarray(share, jnp.float32), (6,))
    count = []

    def move(T, number):
        jax.debug.callback(lambda _: count.append(1), number)
        return turn_and_shift(T, (1 - shares) * decoupled_error(T_END, T))

    T = settled(move, jnp.eye(4), least=least, most=most, tolerance=tolerance)
    jax.effects_barrier()
    return T, len(count)


@pytest.mark.parametrize("share", [0.4, 0.7, 0.9])
def test_creeping_steps_reach_their_end_in_half_of_the_time(share):
    tolerance = 1e-4
    T, num = _steps(share, tolerance)
    np.testing.assert_allclose(T, T_END, atol=10 * tolerance)
    alone = np.log(tolerance / (0.3 * (1 - share))) / np.log(share)
    assert num <= 0.5 * alone + 2


@pytest.mark.parametrize("share", [-0.6, 0.0, 0.25])
def test_steps_that_swing_or_shrink_fast_are_left_alone(share):
    T, num = _steps(share, 1e-5)
    alone = np.log(1e-5 / (0.3 * (1 - share))) / np.log(max(abs(share), 1e-5))
    assert num <= alone + 3
    np.testing.assert_allclose(T, T_END, atol=1e-4)


def test_shares_that_differ_by_direction_do_no_harm():
    T, num = _steps([0.9, 0.1, -0.5, 0.8, 0.3, 0.6], 1e-5)
    np.testing.assert_allclose(T, T_END, atol=2e-4)
    assert num < 60


def test_no_more_steps_than_asked():
    assert _steps(0.9, 0.0, most=7)[1] == 7
    assert _steps(0.0, 1.0, least=3)[1] == 3


def test_poses_stay_rigid():
    T, _ = _steps(0.7, 1e-5)
    np.testing.assert_allclose(lie.inverse(T) @ T, np.eye(4), atol=1e-6)
