"""Poses between the frames of the input and those of the methods."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion

from jaxreg.cloud import Frames
from jaxreg.cloud.frames import _distinct_enough


@pytest.mark.parametrize("d", [2, 3])
def test_a_pose_moves_centred_points_as_it_moves_the_points(d):
    rng = np.random.default_rng(d)
    means, radius, T = 5 * rng.standard_normal((2, d)), 3.0, motion(d, d, shift=4.0)
    frames = Frames(*map(jnp.float32, (*means, radius)))
    assert frames.d == d
    inside = frames.enter(jnp.asarray(T, jnp.float32))
    points = means[0] + rng.standard_normal((9, d))
    moved = points @ T[:d, :d].T + T[:d, d]
    centred = (points - means[0]) / radius
    found = centred @ np.asarray(inside)[:d, :d].T + np.asarray(inside)[:d, d]
    np.testing.assert_allclose(found, (moved - means[1]) / radius, atol=1e-5)
    np.testing.assert_allclose(frames.leave(inside), T, atol=1e-5)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("more", [0, 1])
def test_clouds_need_one_more_distinct_point_than_dimensions(d, more):
    rng = np.random.default_rng(0)
    # Of as many masked rows as valid ones, which repeat a few points.
    distinct = rng.standard_normal((d + more, d))
    points = np.concatenate([np.resize(distinct, (9, d)), rng.standard_normal((9, d))])
    mask = jnp.arange(18) < 9
    found = _distinct_enough(jnp.asarray(points, jnp.float32), mask)
    assert bool(found) == (more == 1)
