"""Covariances of poses of scans, of a sculpture."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxreg as jr
from jaxreg.linear import laplacian
from jaxreg.local.answer import answer
from jaxreg.local.steps import turn_and_shift
from jaxreg.matching.problem import match
from jaxreg.multiview import follow_motions, surface_errors
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.refine import WIDTH_END, optimiser_of


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


def test_joint_covariances_are_those_of_each_scan_and_of_what_lies_between(found):
    scans, _, sol = found
    told = {"relative_to": 2}
    joint = np.asarray(jr.joint_scan_covariances(scans, sol, **told), np.float64)
    own = np.asarray(jr.scan_covariances(scans, sol, **told), np.float64)
    size = np.sqrt(np.einsum("vaa->va", own))
    # Two programs round otherwise; in float64 they agree to 1e-14.
    of_size = 1e-3 * size[:, :, None] * size[:, None]
    assert np.all(np.abs(np.einsum("vvab->vab", joint) - own) <= of_size)
    across = 1e-4 * np.einsum("va,wb->vwab", size, size)
    assert np.all(np.abs(joint - joint.transpose(1, 0, 3, 2)) <= across)
    # Relative to a neighbour, by these and as asked for.
    k, first = 6, 5
    again = np.asarray(jr.scan_covariances(scans, sol, relative_to=first)[k])
    T = np.asarray(sol.T_world_i, np.float64)
    middle = [T[i, :3, :3] @ scans[i].mean(axis=0) + T[i, :3, 3] for i in range(NUM)]
    turn = T[k, :3, :3].T @ T[first, :3, :3]
    lever = T[first, :3, :3].T @ (middle[k] - middle[first])
    carried = np.kron(np.eye(2), turn)
    carried[:3, 3:] = turn @ np.cross(np.eye(3), lever).T
    J = np.concatenate([np.eye(6), -carried], axis=1)
    rows = [k, first]
    both = joint[np.ix_(rows, rows)].transpose(0, 2, 1, 3).reshape(12, 12)
    ratio = eigh(J @ both @ J.T, again, eigvals_only=True)
    assert np.all((ratio > 0.5) & (ratio < 2)), ratio


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
    for k, R in ((1, np.eye(3)), (2, S[:3, :3])):
        turn = unit[:, None] * np.kron(np.eye(2), R)
        wanted = turn @ C[k] @ turn.T
        # Of deviations in any direction.
        ratio = np.sqrt(eigh(again[k], wanted, eigvals_only=True))
        assert np.all((ratio**2 > 0.7) & (ratio**2 < 1.4)), ratio


def test_the_answer_of_some_points_is_that_of_all_to_small_motions(found):
    scans, _, sol = found
    given = GivenScans.of(scans[:2], None, None)
    prepared, _ = given.prepared(jr.ParticleFilter(), None, to_search=False)
    problem = prepared.problem(*jnp.arange(2), exact=True)
    T_0_1 = np.linalg.inv(sol.T_world_i[0]) @ sol.T_world_i[1]
    T_0_1 = prepared.to_centred_frames(
        jnp.asarray(T_0_1)[None], *jnp.arange(2)[:, None]
    )
    T_0_1, width = T_0_1[0], WIDTH_END * jnp.max(prepared.spacing)
    optimiser = optimiser_of(T_0_1)

    @jax.jit
    def pulled(tangent):
        near = match(problem, turn_and_shift(T_0_1, tangent))
        weight = optimiser.weights(near, width)
        return jnp.sum(optimiser.residual.descents(near) * weight, axis=1)

    @jax.jit
    def told():
        at = match(problem, T_0_1)
        weight = optimiser.weights(at, width)
        H, _ = optimiser.residual.normal_equations(at, weight)
        return answer(optimiser, problem, T_0_1, at, width, weight, H), H

    A, H = (np.asarray(x, np.float64) for x in told())
    white = np.linalg.inv(np.linalg.cholesky(H)).T
    far = 1e-3 * np.sqrt(np.trace(H) / 6)  # of some thousandths of the radius
    slopes = [pulled(jnp.array(-x)) - pulled(jnp.array(x)) for x in far * white.T]
    wanted = np.stack(slopes, axis=1) / (2 * far)
    share = white.T @ A @ white
    assert np.linalg.norm(share - white.T @ wanted, 2) < 0.2


@pytest.mark.parametrize("limit", [2, 128])  # by gradients, and by a factor
def test_poses_follow_the_errors_of_their_motions(monkeypatch, limit):
    monkeypatch.setattr(laplacian, "DENSE_LIMIT", limit)
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [1, 3]])
    weight, v, first = np.array([1.0, 0.5, 2.0, 1.0, 0.3]), 4, 2
    T = np.stack([motion(k, 3, angle=1.0, shift=2.0) for k in range(v)])
    rng = np.random.default_rng(0)
    # What a motion was measured as, less what of the poses it repeats.
    y, root = rng.normal(size=(v, v, 6, 1)), rng.normal(size=(v, v, 6, 6))
    share = root @ np.swapaxes(root, -1, -2) / 6
    y = share @ y
    own = follow_motions.follow_motions(
        jnp.asarray(edges),
        jnp.asarray(weight, jnp.float32),
        jnp.asarray(T, jnp.float32),
        jnp.asarray(first),
        lambda i, j: (jnp.asarray(y)[i, j][None], jnp.asarray(share)[i, j]),
        (1, 1),
    )[0, :, :, 0]
    # Velocities of the frames at the points of j, all in the axes of the world.
    rows, told = [], []
    for (i, j), w in zip(edges, weight, strict=True):
        row, lever = np.zeros((6, v, 6)), T[j, :3, 3] - T[i, :3, 3]
        row[:, j] += np.eye(6)
        row[:, i] -= np.eye(6)
        row[:3, i, 3:] -= np.stack([np.cross(x, lever) for x in np.eye(3)], axis=1)
        half = np.sqrt(w) * np.linalg.cholesky(share[i, j]).T
        rows.append(np.tensordot(half, row, axes=1))
        told.append(half @ np.linalg.solve(share[i, j], y[i, j, :, 0]))
    J = np.delete(np.concatenate(rows), first, axis=1).reshape(-1, 6 * (v - 1))
    x = np.linalg.lstsq(J, np.concatenate(told))[0].reshape(v - 1, 6)
    np.testing.assert_allclose(np.delete(own, first, axis=0), x, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(own[first], 0, atol=1e-3)


def test_errors_that_wide_parts_of_scans_share_widen_the_regions(found):
    scans, _, sol = found
    deviations = []
    for shared in (True, False):
        rng, moved = np.random.default_rng(0), []
        for scan in scans:
            # Along every axis as large, once in waves over a scan, once here and there.
            turns = 2 * np.pi * scan[:, [1, 2, 0]] / np.ptp(scan, axis=0).max()
            off = 5e-4 * np.sin(2 * turns + rng.uniform(0, 6, 3))
            off = off if shared else rng.permutation(off)
            moved.append((scan + off).astype(np.float32))
        C = np.asarray(jr.scan_covariances(moved, sol))
        deviations.append(np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2).mean()))
    # Three times by cells of two spacings alone, which are parts of waves, too.
    assert deviations[0] > 4 * deviations[1]


def test_of_scans_that_no_pair_holds_nothing_is_known(found):
    scans, _, sol = found
    lost = jnp.any(sol.averaged.pairs == 4, axis=1)
    weight = jnp.where(lost, 0, sol.averaged.weight)
    averaged = jr.AveragedPairs(sol.averaged.pairs, weight)
    C = jr.scan_covariances(scans, dataclasses.replace(sol, averaged=averaged))
    assert np.isnan(C[4]).all()
    assert np.isfinite(np.delete(C, 4, axis=0)).all()


def test_of_many_scans_covariances_are_those_of_few(found, monkeypatch):
    scans, _, sol = found
    C = np.asarray(jr.scan_covariances(scans, sol, relative_to=3))
    monkeypatch.setattr(laplacian, "DENSE_LIMIT", 2)
    monkeypatch.setattr(surface_errors, "_MOST", 512)
    jax.clear_caches()
    again = np.asarray(jr.scan_covariances(scans, sol, relative_to=3))
    assert not again[3].any()
    for k in set(range(NUM)) - {3}:
        own, other = (np.sqrt(np.diag(x[k])) for x in (C, again))
        np.testing.assert_allclose(other, own, rtol=0.25)


def test_other_scans_are_refused(found):
    scans, _, sol = found
    with pytest.raises(ValueError, match="solution: wanted one of 7 scans, found 8"):
        jr.scan_covariances(scans[:7], sol)
    with pytest.raises(ValueError, match="relative_to: wanted a scan below 8, found 8"):
        jr.scan_covariances(scans, sol, relative_to=8)
