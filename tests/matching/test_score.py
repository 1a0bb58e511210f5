"""How two surfaces are scored at a pose, and whether they can slip."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.cloud import PointCloud
from jaxreg.matching import Grip, Problem, Score, can_slip, match, mutual_overlap, score
from jaxreg.neighbours import BruteForce


pytestmark = pytest.mark.usefixtures("quickly_compiled")


SPACING = 0.1
EYE = jnp.eye(4)


def _cloud(points: np.ndarray, normals: np.ndarray) -> PointCloud:
    return PointCloud(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(normals, jnp.float32),
        jnp.ones(len(points), bool),
    )


def _problem(source: PointCloud, target: PointCloud) -> Problem:
    return Problem.of(source, target, BruteForce.build(target.points, target.mask))


def _floor(height: float, shift: float = 0.0) -> np.ndarray:
    """16 x 16 points a spacing apart, moved up and along x."""
    x, y = np.meshgrid(np.arange(16), np.arange(16))
    points = SPACING * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return points + [shift, 0.03, height]


UP = np.tile([0.0, 0.0, 1.0], (256, 1))


def _score(source: np.ndarray, normals: np.ndarray = UP) -> Score:
    problem = _problem(_cloud(source, normals), _cloud(_floor(0), UP))
    return score(problem, EYE, jnp.float32(SPACING))


@pytest.mark.parametrize(
    ("height", "agree", "conflict"),
    [(0, 256, 0), (0.01, 256, 0), (0.03, 0, 0), (0.1, 0, 256), (0.25, 0, 256)],
)
def test_points_agree_on_a_surface_and_conflict_over_or_under_it(
    height, agree, conflict
):
    for side in (-1, 1):
        found = _score(_floor(side * height))
        assert int(found.num_inliers) == agree
        assert int(found.num_conflicts) == conflict
        assert float(found.fitness) == pytest.approx(agree / 256)


def test_points_far_over_or_beyond_a_surface_do_not_conflict_with_it():
    assert int(_score(_floor(0.4)).num_conflicts) == 0
    half_beyond = _score(_floor(0.1, shift=8 * SPACING))
    assert int(half_beyond.num_conflicts) == 8 * 16
    across = np.tile([1.0, 0.0, 0.0], (256, 1))
    assert int(_score(_floor(0.1), across).num_conflicts) == 0


def test_conflicts_lessen_the_overlap():
    source = np.concatenate([_floor(0)[:128], _floor(0.1)[128:]])
    found = _score(source)
    assert float(found.consistency) == 0.5
    assert float(mutual_overlap(found, found)) == pytest.approx(0.5 * 0.5**2)
    none = _score(_floor(1.0))
    assert float(mutual_overlap(none, none)) == 0


@pytest.mark.parametrize("shares", [(0.6, 0.5), (0.9, 0.1), (0.1, 0.9)])
def test_overlap_is_the_mean_of_both_shares_and_at_most_twice_the_lesser(shares):
    one, other = (
        Score(jnp.float32(x), jnp.float32(0), *map(jnp.int32, (80, agree, 0)))
        for x, agree in zip(shares, (0, 20), strict=True)
    )
    expected = min(np.sqrt(shares[0] * shares[1]), 2 * min(shares)) * 80 / 100
    assert float(mutual_overlap(one, other)) == pytest.approx(expected, rel=1e-5)


def test_masked_points_are_in_no_share_and_have_no_weight():
    cloud, target = _cloud(_floor(0.01), UP), _cloud(_floor(0), UP)
    mask = jnp.arange(256) < 100
    cloud = PointCloud(cloud.points, cloud.normals, mask)
    problem = _problem(cloud, target)
    found = score(problem, EYE, jnp.float32(SPACING))
    assert int(found.num_inliers) == 100
    assert float(found.fitness) == 1
    assert float(found.inlier_rmse) == pytest.approx(0.01, rel=1e-3)
    agreement = match(problem, EYE).agreement
    np.testing.assert_allclose(agreement, np.where(mask, 1, 0), atol=1e-5)


def _slips(points: np.ndarray, normals: np.ndarray) -> bool:
    cloud = _cloud(points, normals)
    return bool(can_slip(_problem(cloud, cloud), EYE, jnp.float32(SPACING)))


def test_surfaces_that_move_in_themselves_slip():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((400, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    assert _slips(x, x)  # a sphere
    ring = x * [1, 1, 0] / np.linalg.norm(x[:, :2], axis=1, keepdims=True)
    assert _slips(ring + x * [0, 0, 1], ring)  # a cylinder
    assert _slips(_floor(0), UP)
    cube = np.where(np.abs(x) == np.abs(x).max(1, keepdims=True), np.sign(x), 0)
    assert not _slips(cube + x * (cube == 0), cube)


def _grip(points: np.ndarray, normals: np.ndarray) -> Grip:
    cloud = _cloud(points, normals)
    found = match(_problem(cloud, cloud), EYE)
    return Grip.of(found, found.rotated, jnp.ones(len(points), bool))


def test_three_floors_hold_together_what_none_of_them_holds():
    # Planes across the three axes, off the origin.
    turns = [np.roll(np.eye(3), k, axis=1) for k in range(3)]
    grips = [_grip((_floor(0) + 1) @ R, UP @ R) for R in turns]
    for some in itertools.product([False, True], repeat=3):
        chosen = [g for g, use in zip(grips, some, strict=True) if use]
        if chosen:
            total = jax.tree.map(lambda *x: sum(x), *chosen)
            assert bool(total.holds) == (len(chosen) == 3)


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
    T = jnp.asarray(motion(seed, 3), jnp.float32)
    for seen in (grip, grip.seen_from(T)):
        if abs(least - 0.07) > 1e-4:
            assert bool(seen.holds) == (least > 0.07)


def test_points_without_normals_hold_a_pose():
    points = blob(400, 3)
    assert not _slips(points, np.zeros_like(points))


def test_points_that_the_other_scanner_looked_through_speak_against_a_pose():
    wall, ahead = _cloud(_floor(0), UP), np.concatenate([_floor(0), _floor(1)[100:104]])
    eye = jnp.array([0.75, 0.75, 3.0])
    source = _cloud(ahead, np.tile([0.0, 0.0, 1.0], (260, 1)))
    for target, before in ((wall, 0), (wall.seen_from(eye), 4)):
        found = score(_problem(source, target), EYE, jnp.float32(SPACING))
        assert int(found.num_before) == before
        assert int(found.num_inliers) == 256
        assert float(found.consistency) == pytest.approx(256 / (256 + 100 * before))
