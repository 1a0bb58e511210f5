"""`reconstruct` with fixed scans, priors and control points, of a sculpture."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, move, pose_error, switched_on

import jaxreg as jr
from jaxreg import Status
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses
from jaxreg.matching import NO_EVIDENCE
from jaxreg.multiview import RelativeMotions
from jaxreg.multiview.choose_pairs import all_pairs
from jaxreg.multiview.known_world import KnownWorld, centred
from jaxreg.multiview.prepare import prepare_scans


FILTER = jr.ParticleFilter(num_prior=1024, num_particles=64)
#: Where the world lies, seen from the sculpture.
T_WORLD = motion(11, 3, angle=2.0, shift=3.0)


@pytest.fixture(scope="module")
def found(reconstructed):
    """Scans, their poses in the world, and all motions between them."""
    scans, truth, alone, _, pairs = reconstructed
    found = scans, T_WORLD @ truth, RelativeMotions.joined(pairs), alone
    # The programs that others keep; what follows runs once and is rather compiled fast.
    with switched_on("jax_disable_most_optimizations", to=False):
        _solve(found)
    return found


def _solve(found: Any, **told: Any) -> jr.ReconstructionSolution:
    scans, _, pairs, _ = found
    return jr.reconstruct(
        scans, key=jax.random.key(0), method=FILTER, previous=pairs, **told
    )


def _errors(T_world_i: Any, truth: np.ndarray) -> np.ndarray:
    pairs = zip(T_world_i, truth, strict=True)
    return np.array([pose_error(T, T_true) for T, T_true in pairs])


def test_scans_lie_in_the_world_of_those_that_are_fixed(found):
    _, truth, _, alone = found
    sol = _solve(found, fixed=[(k, truth[k]) for k in (3, 6, 7)])
    assert int(sol.status) == Status.CONVERGED
    np.testing.assert_array_equal(sol.T_world_i[3], truth[3].astype(np.float32))
    errors = _errors(sol.T_world_i, truth)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.003
    # The surfaces lie as close as before.
    assert np.sum(sol.edge_weight > 0.5) >= np.sum(alone.edge_weight > 0.5) - 1


def test_wrong_priors_and_points_are_told(found):
    scans, truth, _, _ = found
    information = np.diag([1e4] * 3 + [1e4] * 3)
    off = motion(5, 3, angle=0.5, shift=1.0)
    priors = [
        (k, truth[k] @ off if k == 2 else truth[k], information) for k in range(5)
    ]
    control = []
    for n, k in enumerate([0, 2, 4, 5, 6, 7]):
        seen = np.asarray(scans[k][n], np.float64)
        lies = move(truth[k], seen[None])[0] + (0.7 if n == 3 else 0)
        control.append((k, seen, lies, np.eye(3) * 1e4))
    sol = _solve(found, priors=priors, control=control)
    assert int(sol.status) == Status.CONVERGED
    right = np.asarray(sol.prior_weight) > 0.5
    np.testing.assert_array_equal(np.flatnonzero(~right), [2, 5 + 3])
    errors = _errors(sol.T_world_i, truth)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.003


def test_levelled_scans_and_two_targets_hold_the_world(found):
    scans, truth, _, _ = found
    levels = [(k, truth[k][2, :3], 1e-3) for k in range(8)]
    levels[5] = (5, truth[5][2, :3] + [0.3, 0, 0.2], 1e-3)
    control = []
    for k in (1, 6):
        seen = np.asarray(scans[k][k], np.float64)
        control.append((k, seen, move(truth[k], seen[None])[0], np.eye(3) * 1e6))
    sol = _solve(found, control=control, levels=levels)
    assert int(sol.status) == Status.CONVERGED
    right = np.asarray(sol.prior_weight) > 0.5
    np.testing.assert_array_equal(np.flatnonzero(~right), [2 + 5])
    errors = _errors(sol.T_world_i, truth)
    assert errors[:, 0].max() < 0.02
    assert errors[:, 1].max() < 0.006


@pytest.fixture(scope="module")
def halves(found):
    """The same, but no pair joins scans 0 to 4 with 5 to 7."""
    scans, truth, some, alone = found
    tried = set(map(tuple, some.pairs.tolist()))
    rest = [pair for pair in all_pairs(8).tolist() if tuple(pair) not in tried]
    blank = jax.tree.map(lambda x: np.repeat(x[:1], len(rest), axis=0), some)
    blank = eqx.tree_at(
        lambda p: (p.pairs, p.overlap, p.log_evidence),
        blank,
        (
            np.array(rest, np.int32).reshape(-1, 2),
            np.zeros_like(blank.overlap),
            np.full_like(blank.log_evidence, NO_EVIDENCE),
        ),
    )
    pairs = RelativeMotions.joined([some, blank])
    across = (pairs.pairs < 5).sum(axis=1) == 1
    told = np.where(across[:, None], np.float32(NO_EVIDENCE), pairs.log_evidence)
    return scans, truth, eqx.tree_at(lambda p: p.log_evidence, pairs, told), alone


def _seen(found: Any, k: int, n: int) -> tuple[int, np.ndarray, np.ndarray]:
    seen = np.asarray(found[0][k][n : n + 1], np.float64)
    return k, seen[0], move(found[1][k], seen)[0]


def test_parts_meet_in_the_world(halves):
    _, truth, _, _ = halves
    apart = _solve(halves, fixed=[(k, truth[k]) for k in (5, 6, 7)])
    assert int(apart.status) == Status.DISCONNECTED
    # What lies in the world comes first, though it is the smaller part.
    np.testing.assert_array_equal(apart.placed, np.arange(8) >= 5)
    assert _errors(apart.T_world_i, truth)[5:, 0].max() < 0.02
    places = [(0, 0), (1, 900), (3, 1800), (4, 500), (2, 100)]
    control = [_seen(halves, k, n) for k, n in places]
    sol = _solve(halves, fixed=[(6, truth[6])], control=control)
    assert int(sol.status) == Status.CONVERGED
    errors = _errors(sol.T_world_i, truth)
    assert errors[:, 0].max() < 0.02
    assert errors[:, 1].max() < 0.005


def test_a_fixed_scan_that_no_pair_has_there_is_named(found):
    _, truth, _, _ = found
    wrong = motion(7, 3, angle=0.8, shift=1.0)
    fixed = [(k, truth[k] @ wrong if k == 4 else truth[k]) for k in (1, 2, 4)]
    sol = _solve(found, fixed=fixed)
    expected = np.where(np.arange(8) == 4, Status.NO_AGREEMENT, Status.CONVERGED)
    np.testing.assert_array_equal(sol.scan_status, expected)
    np.testing.assert_array_equal(sol.T_world_i[4], np.float32(fixed[2][1]))
    others = np.delete(np.arange(8), 4)
    assert _errors(sol.T_world_i[others], truth[others])[:, 0].max() < 0.02


def test_points_on_a_line_hold_nothing(found):
    _, truth, _, alone = found
    places = [np.array([0.1 * n, 0, 0]) for n in range(4)]
    lie = [truth[0][:3, :3] @ p + truth[0][:3, 3] for p in places]
    control = [(0, p, q) for p, q in zip(places, lie, strict=True)]
    sol = _solve(found, control=control)
    assert int(sol.status) == Status.DEGENERATE
    np.testing.assert_allclose(sol.T_world_i, alone.T_world_i, atol=1e-5)


def test_map_coordinates_keep_their_digits(found):
    scans, truth, pairs, _ = found
    middle, north = np.array([350_000.0, 5_600_000, 200]), np.array([8e5, 4.2e6, 9])
    far = [scan.astype(np.float64) + middle for scan in scans]
    T = truth.copy()
    T[:, :3, 3] += north - truth[:, :3, :3] @ middle
    moved = np.array(pairs.T_i_j, np.float64)
    moved[..., :3, 3] += middle - moved[..., :3, :3] @ middle
    kept = eqx.tree_at(lambda p: p.T_i_j, pairs, moved)
    control = []
    for k, n in [(0, 5), (1, 70), (4, 900), (5, 20), (7, 1800)]:
        control.append((k, far[k][n], T[k][:3, :3] @ far[k][n] + T[k][:3, 3]))
    sol = _solve((far, T, kept, None), fixed=[(2, T[2])], control=control)
    assert sol.T_world_i.dtype == np.float64
    np.testing.assert_array_equal(sol.T_world_i[2], T[2])
    for points, pose, true in zip(far, sol.T_world_i, T, strict=True):
        assert np.abs(move(pose, points) - move(true, points)).max() < 0.01


def test_poses_follow_what_is_known(found):
    _, truth, _, _ = found
    turn = jnp.asarray(truth[1], jnp.float32)

    def places(shift: jax.Array) -> jax.Array:
        sol = _solve(found, priors=[(1, turn.at[:3, 3].add(shift))])
        return sol.T_world_i[:, :3, 3]

    east = jnp.array([1.0, 0, 0])
    _, slopes = jax.jvp(places, (jnp.zeros(3),), (east,))
    np.testing.assert_allclose(slopes, np.tile(east, (8, 1)), atol=5e-3)
    many = jax.vmap(places)(jnp.stack([0 * east, 0.1 * east]))
    np.testing.assert_allclose(
        many[1] - many[0], 0.1 * np.tile(east, (8, 1)), atol=1e-3
    )


def test_what_is_known_means_the_same_of_centred_scans():
    rng = np.random.default_rng(0)
    points = (3 * rng.normal(size=(2, 60, 3)) + [5, 0, 1]).astype(np.float32)
    scans = prepare_scans(jr.ICP(), jnp.asarray(points), jnp.ones((2, 60), bool))
    half = rng.normal(size=(6, 6))
    W, T = half @ half.T + np.eye(6), motion(3, 3)
    known = KnownWorld.of([(1, T, W)], None, None, None, (2, 3), points.dtype)
    assert known is not None
    moved = centred(dataclasses.replace(known.known, origin=None), scans).poses
    T_off = jnp.asarray(known.known.poses.T_world_prior[0]) @ lie.exp(
        jnp.asarray(1e-3 * rng.normal(size=6), jnp.float32)
    )

    def square(poses: KnownPoses, T_world_i: jax.Array) -> float:
        error = lie.log(lie.inverse(poses.T_world_prior[0]) @ T_world_i)
        assert poses.information is not None
        return float(error @ poses.information[0] @ error)

    R, t = T_off[:3, :3], T_off[:3, 3]
    middle = lie.compose(R, (t + R @ scans.mean[1]) / scans.radius)
    wanted = square(known.known.poses, T_off)
    assert square(moved, middle) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"fixed": [(8, np.eye(4))]}, r"fixed\[0\]: wanted a frame below 8, found 8"),
        ({"priors": [(0, 2 * np.eye(4))]}, r"priors\[0\]: .*rigid"),
        ({"control": [(0, np.zeros(3), np.zeros(3))]}, "control: wanted at least 3"),
    ],
)
def test_wrong_rows_are_named(found, told, words):
    with pytest.raises(ValueError, match=words):
        _solve(found, **told)


def test_poses_to_hold_are_given_as_fixed_ones(found):
    scans, truth, _, alone = found
    with pytest.raises(ValueError, match="hold_previous: .* as fixed="):
        jr.reconstruct(
            scans,
            key=jax.random.key(0),
            previous=alone,
            hold_previous=True,
            fixed=[(0, truth[0])],
        )
