"""Whether surfaces that agree can slip along each other."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from evidence_clouds import EYE, UP, as_cloud, evidence, floor
from helpers import blob, motion
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.cloud import PointCloud
from jaxreg.matching import Grip, Problem, match
from jaxreg.neighbours import BruteForce


def _slips(points: np.ndarray, normals: np.ndarray) -> bool:
    cloud = as_cloud(points, normals)
    return not bool(_seen(evidence(cloud, cloud, EYE).grip, EYE, 1.0)[0])


def test_surfaces_that_move_in_themselves_slip():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((400, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    assert _slips(x, x)  # a sphere
    ring = x * [1, 1, 0] / np.linalg.norm(x[:, :2], axis=1, keepdims=True)
    assert _slips(ring + x * [0, 0, 1], ring)  # a cylinder
    assert _slips(floor(0), UP)
    cube = np.where(np.abs(x) == np.abs(x).max(1, keepdims=True), np.sign(x), 0)
    assert not _slips(cube + x * (cube == 0), cube)


def test_points_without_normals_hold_a_pose():
    points = blob(400, 3)
    assert not _slips(points, np.zeros_like(points))


@jax.jit
def _of_cloud(cloud: PointCloud) -> Grip:
    index = BruteForce.build(cloud.points, cloud.mask)
    found = match(Problem.of(cloud, cloud, index), EYE)
    return Grip.of(found, found.rotated, jnp.ones(len(cloud.mask), bool))


def _grip(points: np.ndarray, normals: np.ndarray) -> Grip:
    return _of_cloud(as_cloud(points, normals, len(points)))


@jax.jit
def _seen(grip: Grip, T: jax.Array, radius: float) -> tuple[jax.Array, jax.Array]:
    """Whether it holds, and how firmly, in the frame that `T` leads to."""
    there = grip.seen_from(T)
    return there.holds, there.firmness(jnp.asarray(radius, jnp.float32))


def test_three_floors_hold_together_what_none_of_them_holds():
    # Planes across the three axes, off the origin.
    turns = [np.roll(np.eye(3), k, axis=1) for k in range(3)]
    grips = [_grip((floor(0) + 1) @ R, UP @ R) for R in turns]
    for some in itertools.product([False, True], repeat=3):
        chosen = [g for g, use in zip(grips, some, strict=True) if use]
        if chosen:
            total = jax.tree.map(lambda *x: sum(map(np.asarray, x)), *chosen)
            assert bool(_seen(total, EYE, 1.0)[0]) == (len(chosen) == 3)


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_a_grip_holds_if_its_least_eigenvalue_is_large(seed):
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((16, 3))
    normals = rng.standard_normal((16, 3)) * rng.uniform(0.05, 0.25)
    x = points - points.mean(0)
    J = np.concatenate([normals, np.cross(x, normals)], axis=1)
    least = np.sqrt(np.linalg.eigvalsh(J.T @ J / 16)[0])
    grip = _grip(points, normals)
    for T in (np.eye(4), motion(seed, 3)):
        holds, _ = _seen(grip, T.astype(np.float32), 1.0)
        if abs(least - 0.07) > 1e-4:
            assert bool(holds) == (least > 0.07)


@given(st.integers(0, 1000), st.floats(0.1, 10.0))
@settings(max_examples=20, deadline=None)
def test_firmness_is_a_log_determinant_in_any_frame_and_unit(seed, unit):
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((16, 3)) * rng.uniform(0.2, 1, 3)
    normals = rng.standard_normal((16, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    x = points - points.mean(0)
    J = np.concatenate([normals, np.cross(x, normals)], axis=1)
    moved = np.linalg.eigvalsh(J.T @ J / 16) + 0.02**2
    expected = np.log(moved / np.array([1 / 3] * 3 + [2 / 9] * 3)).sum() / 2
    grip = _grip(unit * points, normals)
    for T in (np.eye(4), motion(seed, 3)):
        _, found = _seen(grip, T.astype(np.float32), unit)
        np.testing.assert_allclose(found, min(expected, 0), atol=2e-3)


def test_what_slips_is_hardly_firm_and_planes_all_round_are_firmest():
    rng = np.random.default_rng(0)
    x, n = rng.standard_normal((2, 2000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    firmest = float(_seen(_grip(x, n), EYE, 1.0)[1])
    assert -0.05 < firmest <= 0
    sphere = float(_seen(_grip(x, x), EYE, 1.0)[1])
    assert sphere < -9  # three turns of 0.02 in place of 0.47
