"""Derivatives of the poses of many scans by a calibration of their sensor."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg import Status
from jaxreg.testing.problems import motion, move, surface


NUM_SCANS, NUM_POINTS = 3, 256


@pytest.fixture(scope="module", autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def scans():
    """Samples of one surface, a little apart: any method finds how they lie."""
    return np.stack(
        [
            move(motion(3, 0.04 * i, 0.03, i), surface(NUM_POINTS, 3, i)) + [0.0, 0, 4]
            for i in range(NUM_SCANS)
        ]
    )


@pytest.fixture(scope="module")
def sloped():
    """A number made of all poses, the status, and the slopes by calibration and scans.

    One compiled program, of a range bias, a scale and a stretch along an axis.
    """
    weight = np.cos(np.arange(NUM_SCANS * 16.0)).reshape(NUM_SCANS, 4, 4)

    def number(calibration, scans, mask):
        bias, scale, stretch = calibration
        sight = scans / jnp.linalg.norm(scans, axis=-1, keepdims=True)
        seen = (1 + scale) * scans + bias * sight
        seen = seen + stretch * scans * jnp.array([1.0, 0, 0])
        solution = jr.reconstruct(
            seen, mask=mask, method=jr.ICP(max_steps=20), key=jax.random.key(0)
        )
        return jnp.sum(weight * solution.T_world_i), solution.status

    program = jax.jit(jax.value_and_grad(number, argnums=(0, 1), has_aux=True))

    def run(scans, calibration=(0.0, 0.0, 0.0), mask=None):
        mask = np.ones(scans.shape[:2], bool) if mask is None else mask
        return jax.device_get(program(jnp.asarray(calibration), scans, mask))

    return run


def test_slopes_are_those_of_central_differences(scans, sloped):
    # So near to rest lead the last four steps of a pair; twelve lead twice as near.
    near = 5e-3
    (_, status), (slopes, by_points) = sloped(scans)
    assert status == Status.CONVERGED
    step = 1e-6
    differences = []
    for way in np.eye(3):
        ends = [sloped(scans, sign * step * way)[0][0] for sign in (1, -1)]
        differences.append((ends[0] - ends[1]) / (2 * step))
    np.testing.assert_allclose(slopes, differences, rtol=near, atol=1e-5)
    assert np.abs(differences).min() > 0.02
    apart = np.random.default_rng(0).standard_normal(scans.shape)
    ends = [sloped(scans + sign * step * apart)[0][0] for sign in (1, -1)]
    told = np.sum(by_points * apart)
    np.testing.assert_allclose(told, (ends[0] - ends[1]) / (2 * step), rtol=near)


@pytest.mark.parametrize(
    "spoiled",
    [
        lambda x, mask: (x * [1, 1, 0], mask),
        lambda x, mask: (0 * x + 1, mask),
        lambda x, mask: (x, mask & (np.arange(NUM_SCANS) > 0)[:, None]),
        lambda x, mask: (np.random.default_rng(0).standard_normal(x.shape), mask),
        lambda x, mask: (x * [[[1]], [[1e-3]], [[1]]], mask),
    ],
    ids=["planes", "one place", "a masked scan", "noise", "another unit"],
)
def test_slopes_are_finite_where_scans_say_little(scans, sloped, spoiled):
    points, mask = spoiled(scans, np.ones(scans.shape[:2], bool))
    (value, status), slopes = sloped(points, mask=mask)
    assert np.isfinite(value)
    assert status != Status.CONVERGED
    chex.assert_tree_all_finite(slopes)
