"""What is left of a group's own error at a root, beside regressions in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.local.leverage import share_left


GROUPS, EACH = 6, 5


@pytest.fixture(scope="module")
def regression() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3, GROUPS * EACH))
    return rows, rng.uniform(0.2, 2, GROUPS * EACH), np.repeat(np.arange(GROUPS), EACH)


def test_along_one_axis_what_is_left_is_what_all_others_hold(regression):
    rows, weight, group = regression
    rows = rows[:1]
    held = np.bincount(group, weight * rows[0] ** 2)
    left = _left(np.full((GROUPS, 1), 0.3), rows, weight, group)
    np.testing.assert_allclose(left, 1 - held / held.sum(), rtol=1e-5)
    # Pulls of errors alike, at the root, have the squares held * left.
    at_root = np.diag(weight * rows[0]) @ (np.eye(len(group)) - _hat(rows, weight))
    pulls = np.stack([at_root[group == g].sum(axis=0) for g in range(GROUPS)])
    squares = np.sum(pulls**2 / weight, axis=1)
    np.testing.assert_allclose(squares / left, held, rtol=1e-5)


def test_who_holds_an_axis_alone_shows_a_tenth_of_its_error(regression):
    rows, weight, group = regression
    rows = np.array(rows)
    rows[2, group != 0] = 0
    led = np.tile(np.array([0.0, 0.0, 0.2]), (GROUPS, 1))
    left = _left(led, rows, weight, group)
    assert left[0] == pytest.approx(0.1)
    np.testing.assert_allclose(left[1:], 1)


def test_who_pulls_at_nothing_is_left_whole(regression):
    np.testing.assert_array_equal(_left(np.zeros((GROUPS, 3)), *regression), 1)


def _left(led, rows, weight, group) -> np.ndarray:
    told = (jnp.asarray(x) for x in (led, rows, weight, group))
    return np.asarray(share_left(*told))


def _hat(rows: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What the fit makes of errors: rows^T H^-1 rows W."""
    H = rows * weight @ rows.T
    return rows.T @ np.linalg.solve(H, rows * weight)
