"""What the derivative of the evidence of a pose says of other poses."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evidence_clouds import EYE, UP, as_cloud, floor, thinned, witness
from helpers import switched_on

from jaxreg.cloud import PointCloud
from jaxreg.datasets import sculpture_scans
from jaxreg.local import turn_and_shift


@pytest.fixture(autouse=True, scope="module")
def _strict() -> Iterator[None]:
    """What is not a number raises."""
    with switched_on("jax_debug_nans"):
        yield


@pytest.fixture(scope="module")
def scans() -> list[PointCloud]:
    """Two views of a sculpture in one frame, about its middle, in float64."""
    points, T_world_i = sculpture_scans(12, seed=0)
    views = [
        (x.astype(float) @ T[:3, :3].T + T[:3, 3]) / 0.08
        for x, T in zip(points[:2], T_world_i, strict=False)
    ]
    with jax.enable_x64(True):
        clouds = [thinned(x, 512, len(max(views, key=len))) for x in views]
    return [PointCloud(x.points, x.normals, x.mask) for x in clouds]


@jax.jit
@partial(jax.value_and_grad, argnums=3)
def _moved(
    source: PointCloud, target: PointCloud, T: jax.Array, x: jax.Array
) -> jax.Array:
    """Evidence of the pose moved by `x`, with the slopes by that: one program."""
    told = witness(source, target)
    return told.of_pose(turn_and_shift(T, x)).log_evidence


REST = np.zeros(6, np.float32)


def test_slopes_predict_what_a_motion_of_some_tenths_of_a_spacing_changes(scans):
    rng = np.random.default_rng(0)
    pair = [as_cloud(np.asarray(x.points), np.asarray(x.normals), 512) for x in scans]
    pair = [replace(x, mask=y.mask) for x, y in zip(pair, scans, strict=True)]
    spacing = np.median(jax.jit(lambda *x: witness(*x).spacings[0])(*pair))
    turn = jax.jit(turn_and_shift)
    found, predicted = [], []
    for _ in range(16):
        off, x = 0.5 * spacing * rng.normal(size=(2, 6)) * [[1], [0.3]]
        off, x = off.astype(np.float32), x.astype(np.float32)
        T = turn(EYE, off)
        ends = [float(_moved(*pair, T, sign * x)[0]) for sign in (1, -1)]
        found.append(ends[0] - ends[1])
        predicted.append(2 * float(np.asarray(_moved(*pair, T, REST)[1]) @ x))
    assert np.corrcoef(found, predicted)[0, 1] > 0.95
    assert np.dot(found, predicted) / np.dot(predicted, predicted) == pytest.approx(
        1, abs=0.2
    )
    # Without the numbers of points, most would be missing.
    assert np.std(found) > 0.5


def test_slopes_by_points_are_those_of_one_unit_one_frame_and_the_pose(scans):
    def value(h, x):
        """In another unit, all moved; or the source moved, by points or by the pose."""
        T = turn_and_shift(jnp.eye(4), h[1] * x)
        clouds = []
        for number, cloud in enumerate(scans):
            move = T @ turn_and_shift(jnp.eye(4), (number == 0) * h[2] * x)
            points = cloud.points @ move[:3, :3].T + move[:3, 3]
            normals = cloud.normals @ move[:3, :3].T
            clouds.append(PointCloud(jnp.exp(h[0]) * points, normals, cloud.mask))
        return witness(*clouds).of_pose(turn_and_shift(jnp.eye(4), h[3] * x))

    with jax.enable_x64(True):
        # A shift: directions of normals are counted in bins that do not turn along.
        x = np.array([0.1, -0.06, 0.08, 0, 0, 0])
        slopes = jax.jit(jax.jacrev(lambda h: value(h, x).log_evidence))(np.zeros(4))
    unit, frame, by_points, by_pose = map(float, slopes)
    assert abs(by_pose) > 0.1
    assert by_points == pytest.approx(by_pose, rel=1e-6)
    assert unit == pytest.approx(0, abs=1e-6 * abs(by_pose))
    assert frame == pytest.approx(0, abs=1e-6 * abs(by_pose))


def test_exact_and_far_clouds_have_slopes_that_are_numbers():
    ground, bare = as_cloud(floor(0), UP, 512), as_cloud(floor(0), 0 * UP, 512)
    for pair in ((ground, ground), (bare, bare)):
        assert np.isfinite(_moved(*pair, EYE, REST)[1]).all()
    assert not np.any(_moved(ground, as_cloud(floor(9), UP, 512), EYE, REST)[1])
