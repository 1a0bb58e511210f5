"""Covariances of poses of scans, of a sculpture."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxreg as jr


pytestmark = pytest.mark.usefixtures("fully_compiled")


NUM = 8


@pytest.fixture(scope="module")
def found(reconstructed):
    """Scans, true poses, and a solution."""
    return reconstructed.scans, reconstructed.truth, reconstructed.solution


def _error(T: np.ndarray, true: np.ndarray, middle: np.ndarray) -> np.ndarray:
    off = np.linalg.inv(T) @ true
    turn = Rotation.from_matrix(off[:3, :3]).as_rotvec()
    return np.append(off[:3, :3] @ middle + off[:3, 3] - middle, turn)


@pytest.mark.parametrize("first", [0, 5])
def test_true_poses_lie_within_what_is_said_of_the_error(found, first):
    scans, truth, sol = found
    C = np.asarray(jr.scan_covariances(scans, sol, relative_to=first), np.float64)
    assert not C[first].any()
    T = np.asarray(sol.T_world_i, np.float64)
    squares, ratios = [], []
    for k in set(range(NUM)) - {first}:
        true, own = (np.linalg.inv(X[first]) @ X[k] for X in (truth, T))
        e = _error(own, true, scans[k].mean(axis=0))
        squares.append(e @ np.linalg.solve(C[k], e))
        ratios.append(np.sqrt(np.trace(C[k][:3, :3])) / np.linalg.norm(e[:3]))
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 6)) > 0.8
    assert np.median(ratios) < 5  # and it is not said at random


def test_covariances_have_the_unit_of_the_scans_and_move_with_them(found):
    scans, _, sol = found
    C = np.asarray(jr.scan_covariances(scans, sol))
    # All scans in millimetres, and one in another frame.
    S = motion(3, 3, angle=1.0, shift=0.2)
    moved = [1000 * s for s in scans]
    moved[2] = (moved[2] @ S[:3, :3].T + 1000 * S[:3, 3]).astype(np.float32)
    T = np.array(sol.T_world_i)
    T[2] = T[2] @ np.linalg.inv(S)
    T[:, :3, 3] *= 1000
    other = dataclasses.replace(sol, T_world_i=jnp.asarray(T))
    again = np.asarray(jr.scan_covariances(moved, other))
    unit = np.array([1000.0] * 3 + [1.0] * 3)
    # Other cells, and a turned scan is thinned to other points.
    for k in (1, 2):
        for part in (slice(3), slice(3, None)):
            wanted = np.linalg.eigvalsh((C[k] * np.outer(unit, unit))[part, part])
            own = np.linalg.eigvalsh(again[k][part, part])
            assert np.all((own / wanted > 0.4) & (own / wanted < 2.5))


def test_of_scans_that_no_trusted_pair_holds_nothing_is_known(found):
    scans, _, sol = found
    lost = np.any(np.asarray(sol.graph.edges) == 4, axis=1)
    weight = jnp.where(jnp.asarray(lost), 0, sol.edge_weight)
    C = jr.scan_covariances(scans, dataclasses.replace(sol, edge_weight=weight))
    assert np.isnan(C[4]).all()
    assert np.isfinite(np.delete(C, 4, axis=0)).all()


def test_other_scans_are_refused(found):
    scans, _, sol = found
    with pytest.raises(ValueError, match="solution: wanted one of 7 scans, found 8"):
        jr.scan_covariances(scans[:7], sol)
    with pytest.raises(ValueError, match="relative_to: wanted a scan below 8, found 8"):
        jr.scan_covariances(scans, sol, relative_to=8)
