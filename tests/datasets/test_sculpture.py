import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxreg.datasets import sculpture_scans
from jaxreg.datasets.sculpture import random_motions, sculpture_distance


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], np.ndarray]:
    return sculpture_scans(6, seed=3, points_per_scan=3000)


def _posed(scans: list[np.ndarray], T: np.ndarray) -> list[np.ndarray]:
    return [
        x.astype(float) @ p[:3, :3].T + p[:3, 3] for x, p in zip(scans, T, strict=True)
    ]


def test_shapes_types_and_sizes(views: tuple[list[np.ndarray], np.ndarray]):
    scans, T_world_i = views
    assert len(scans) == 6
    assert T_world_i.shape == (6, 4, 4)
    np.testing.assert_allclose(T_world_i[0], np.eye(4), atol=1e-15)
    for scan in scans:
        assert scan.dtype == np.float32
        assert 2700 < len(scan) < 3300
        assert np.isfinite(scan).all()
        assert 0.1 < np.ptp(scan, axis=0).max() < 0.3


def test_the_truth_brings_the_scans_together(
    views: tuple[list[np.ndarray], np.ndarray],
):
    scans, T_world_i = views
    posed = _posed(scans, T_world_i)
    # Spacing is about 2.5 mm: neighbours overlap at the truth and not as given.
    for a, b in ((0, 1), (2, 3), (5, 0)):
        at_truth = KDTree(posed[b]).query(posed[a])[0] < 3e-3
        as_given = KDTree(scans[b]).query(scans[a])[0] < 3e-3
        assert at_truth.mean() > 0.35
        assert as_given.mean() < 0.2


def test_noise_is_what_was_asked_for():
    clean, T_world_i = sculpture_scans(2, seed=1, noise=0.0, points_per_scan=2000)
    rng = np.random.default_rng(1)
    rng.uniform(size=2)
    T_sculpture_0 = random_motions(rng, 2, 3, spread=0.1)[0]
    noisy, _ = sculpture_scans(2, seed=1, noise=1e-3, points_per_scan=2000)
    spread = []
    for scans in (clean, noisy):
        world = _posed(scans, T_sculpture_0 @ T_world_i)
        distance = sculpture_distance(np.concatenate(world))
        spread.append(np.sqrt(np.mean(distance**2)))
    assert spread[0] < 3e-5
    # Range noise seen at a slant is smaller across the surface.
    assert 4e-4 < spread[1] < 1e-3


def test_same_seed_same_scans_and_another_seed_others():
    first, T_first = sculpture_scans(2, seed=5, points_per_scan=500)
    again, T_again = sculpture_scans(2, seed=5, points_per_scan=500)
    other, T_other = sculpture_scans(2, seed=6, points_per_scan=500)
    np.testing.assert_array_equal(first[1], again[1])
    np.testing.assert_array_equal(T_first, T_again)
    assert not np.allclose(T_first, T_other)
    assert first[1].shape != other[1].shape or not np.allclose(first[1], other[1])


def test_no_rotation_maps_the_sculpture_onto_itself():
    """Coarse search over rotations about the centroid: only the identity fits."""
    scans, T = sculpture_scans(12, seed=0, noise=0.0, points_per_scan=300)
    cloud = np.concatenate(_posed(scans, T))
    cloud -= cloud.mean(axis=0)
    tree = KDTree(cloud)
    turns = random_motions(np.random.default_rng(0), 400, 3, spread=0.0)[:, :3, :3]
    angle = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    fit = np.array([np.mean(tree.query(cloud[::5] @ R.T)[0]) for R in turns])
    at_identity = np.mean(tree.query(cloud[::5] + 1e-9)[0])
    assert (fit[angle > 0.5] > 0.004).all()
    assert at_identity < 1e-6


@pytest.mark.parametrize("d", [2, 3])
def test_random_motions_are_motions(d: int):
    T = random_motions(np.random.default_rng(2), 50, d, spread=2.0)
    R = T[:, :d, :d]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.tile(np.eye(d), (50, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    assert 1 < T[:, :d, d].std() < 3
