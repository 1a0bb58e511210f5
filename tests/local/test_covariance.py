"""Parts of the covariance of a pose: what steps leave, what patches decide alone."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.local import covariance
from jaxreg.local.held_directions import after_steps


@pytest.mark.parametrize("num", [1, 8])
def test_gain_and_share_are_those_of_the_steps_one_by_one(num: int):
    rng = np.random.default_rng(num)
    root, turn = rng.normal(size=(6, 6)), np.linalg.qr(rng.normal(size=(6, 6)))[0]
    H = root @ root.T + np.eye(6)
    half = np.linalg.cholesky(H)
    A = half @ (turn * [0.02, 0.1, 0.3, 0.6, 0.9, 1.0]) @ turn.T @ half.T
    x, g = rng.normal(size=(6, 1)), rng.normal(size=(6, 1))
    gain, share = (np.asarray(m) for m in after_steps(jnp.array(A), jnp.array(H), num))
    end = x
    for _ in range(num):
        end = end + np.linalg.solve(H, g - A @ end)
    np.testing.assert_allclose(x - share @ x + gain @ g, end, rtol=1e-3, atol=1e-4)


def test_what_does_not_answer_is_led_nowhere():
    H, A = np.diag([1.0, 2, 3, 4, 5, 0]), np.diag([1.0, 2, 3, 4, -5, 0])
    gain, share = (np.asarray(m) for m in after_steps(jnp.array(A), jnp.array(H), 8))
    # In a direction that pulls away at most as many steps as there are; unheld: none.
    assert 7.5 / 5 < gain[4, 4] < 8 / 5
    assert share[4, 4] < 0.08
    assert not gain[5].any()
    assert not share[5].any()


def test_a_patch_that_decides_alone_counts_for_more_than_its_pull():
    # Each patch is one cell that pulls along an axis that it alone holds, or all hold.
    patches, k = 6, 6
    pulls, patch, cell = jnp.eye(patches), jnp.arange(patches), jnp.arange(patches)
    alone, all_alike = jnp.eye(k, patches), jnp.ones((k, patches))
    for rows, left in (alone, 0.1), (all_alike, 1 - 1 / patches):
        points = rows, jnp.ones(patches), cell
        found = float(covariance._shared(pulls, patch, jnp.eye(k), points))
        assert found == pytest.approx(patches / left, rel=1e-5)
