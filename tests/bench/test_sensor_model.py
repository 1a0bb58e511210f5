"""Scans of a sensor with its faults, their bound, and poses of a turntable."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.sensor_model import (
    SensorScan,
    information,
    pair_bound,
    seen_from,
    sensor_scans,
)
from bench.turntable import without_displacement
from jaxreg.datasets.sculpture import random_motions


@pytest.fixture(scope="module")
def pair() -> list[SensorScan]:
    return sensor_scans(12, seed=0, pixels=60)[:2]


def test_the_bound_is_the_error_of_whoever_knows_the_surface(pair: list[SensorScan]):
    scan = pair[0]
    rows = np.isfinite(scan.deviation)
    n, u, s = scan.normal[rows], scan.beam[rows], scan.deviation[rows]
    slant = np.sum(n * u, axis=1)
    J = np.concatenate([n, np.cross(scan.true[rows], n)], axis=1) / (s * slant)[:, None]
    H = information(scan, np.ones(len(scan.true), bool))
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(200):
        # Noise along the beam is what the planes see of it.
        x = np.linalg.lstsq(J, rng.normal(size=len(J)), rcond=None)[0]
        squares.append(x @ H @ x)
    assert np.mean(squares) == pytest.approx(6, rel=0.2)


def test_scans_have_the_faults_of_a_sensor(pair: list[SensorScan]):
    scan = pair[0]
    T = scan.T_world_scan
    found = scan.points @ T[:3, :3].T + T[:3, 3]
    off = np.sum((found - scan.true) * scan.beam, axis=1)
    mixed = np.isinf(scan.deviation)
    assert 0 < mixed.mean() < 0.1
    assert np.abs(off[mixed]).max() > 20 * scan.deviation[~mixed].max()
    ratio = off[~mixed] / scan.deviation[~mixed]
    assert np.std(ratio) == pytest.approx(1, rel=0.1)
    # Of a pair the bound counts what both see: less than all.
    both = seen_from(pair[1], scan.true)
    assert 0.2 < both.mean() < 0.95
    alone = np.linalg.inv(information(scan, np.ones(len(scan.true), bool)))
    assert np.all(np.diagonal(pair_bound(*pair)) > np.diagonal(alone))


def test_a_displacement_of_all_published_poses_is_taken_out():
    rng = np.random.default_rng(0)
    T = random_motions(rng, 8, 3, spread=0.2)
    small = np.tile(np.eye(4), (2, 1, 1))
    small[:, :3, :3] = Rotation.from_rotvec(0.02 * rng.normal(size=(2, 3))).as_matrix()
    small[:, :3, 3] = 0.01 * rng.normal(size=(2, 3))
    with jax.enable_x64(True):
        fitted = without_displacement(small[0] @ T @ small[1], T)
    np.testing.assert_allclose(fitted, small[0] @ T @ small[1], atol=1e-8)
