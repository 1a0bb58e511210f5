"""`ICP`: what it reports, and input that leaves it little to work with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error

import jaxreg as jr
from jaxreg import Status
from jaxreg.cloud import PointCloud
from jaxreg.datasets import sculpture_scans
from jaxreg.local import GaussNewton, LocalOptimiser
from jaxreg.local.descent import Limits
from jaxreg.matching import Problem, match
from jaxreg.neighbours import BruteForce
from jaxreg.robust import L2


N, M = 500, 800


def _flat(num: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.zeros((num, 3), np.float32)
    points[:, :2] = rng.uniform(-1, 1, (num, 2))
    return points


def _finite(sol: jr.RegistrationSolution) -> bool:
    return bool(np.all(np.isfinite(sol.T_target_source)))


@pytest.fixture(scope="module")
def near():
    T = motion(3, 3, angle=0.5)
    source, target = move(np.linalg.inv(T), blob(N, 3, seed=1)), blob(M, 3, seed=2)
    init = motion(9, 3, angle=0.1, shift=0.05) @ T
    return source, target, T, init, jr.register(source, target, jr.ICP(), init=init)


def test_covariance_has_the_size_of_the_error(near):
    source, _, T, init, sol = near
    assert sol.covariance.shape == sol.H.shape == (6, 6)
    np.testing.assert_allclose(sol.covariance, sol.covariance.T, rtol=1e-3, atol=1e-9)
    assert float(np.linalg.eigvalsh(sol.covariance).min()) > 0
    angle, _ = pose_error(sol.T_target_source, T)
    deviation = float(np.sqrt(np.trace(sol.covariance[3:, 3:])))
    assert angle / 30 < deviation < 3 * angle + 1e-2
    # Converged: the step that is left is far below that.
    step = np.linalg.solve(np.asarray(sol.H, float), np.asarray(sol.b, float))
    assert np.linalg.norm(step[3:]) < deviation
    assert float(sol.error) > 0
    assert int(sol.num_inliers) == pytest.approx(float(sol.fitness) * N, abs=1)


def test_unit_of_the_input_scales_curvature_and_covariance(near):
    source, target, _, init, sol = near
    init = np.array(init)
    init[:3, 3] *= 1000
    mm = jr.register(1000 * source, 1000 * target, jr.ICP(), init=init)
    unit = np.array([1000.0] * 3 + [1.0] * 3)
    np.testing.assert_allclose(
        mm.covariance / np.outer(unit, unit), sol.covariance, rtol=0.1, atol=1e-7
    )
    np.testing.assert_allclose(mm.inlier_rmse / 1000, sol.inlier_rmse, rtol=0.01)
    np.testing.assert_allclose(mm.error / 1e6, sol.error, rtol=0.01)
    H = np.asarray(mm.H) * np.outer(unit, unit) / 1e6
    np.testing.assert_allclose(H, sol.H, rtol=0.01, atol=1e-3 * np.abs(sol.H).max())
    # The only mode of a local method is its solution.
    for field in ("T_target_source", "inlier_rmse", "covariance", "fitness", "overlap"):
        of_mode = getattr(mm.modes, field)[0]
        np.testing.assert_allclose(of_mode, getattr(mm, field), rtol=1e-5)


def test_errors_that_wide_parts_share_widen_the_region(near):
    _, _, T, _, _ = near
    scan = sculpture_scans(1, seed=1, points_per_scan=M)[0][0][:M]
    scan = (scan - scan.mean(axis=0)) / 0.05
    target, source = scan, scan[:N]
    # Along every axis as large, once in waves over the object, once here and there.
    waves = 0.03 * np.sin(3 * source[:, [1, 2, 0]]).astype(np.float32)
    sizes = []
    for off in (waves, np.random.default_rng(0).permutation(waves)):
        given = move(np.linalg.inv(T), source + off)
        sol = jr.register(given, target, jr.ICP(), init=T)
        assert pose_error(sol.T_target_source, T)[0] < 0.05
        sizes.append(np.sqrt(np.trace(sol.covariance[3:, 3:])))
    assert sizes[0] > 1.5 * sizes[1]


def test_covariance_is_that_of_the_pair_however_it_is_padded(near):
    source, target, _, init, sol = near
    # Rows that count for nothing, before the others and behind.
    clouds = [np.pad(x, ((30, 470), (0, 0))) for x in (source, target)]
    masks = [np.pad(np.ones(len(x), bool), (30, 470)) for x in (source, target)]
    padded = jr.register(
        clouds[0],
        clouds[1],
        jr.ICP(),
        init=init,
        source_mask=masks[0],
        target_mask=masks[1],
    )
    size = np.sqrt(np.diagonal(sol.covariance))
    np.testing.assert_allclose(
        padded.covariance / np.outer(size, size),
        sol.covariance / np.outer(size, size),
        atol=0.1,
    )


def test_pairs_beyond_the_largest_distance_do_not_count(near):
    source, target, T, init, _ = near
    # A second object far from the target would pull the answer under L2.
    far = np.concatenate([source[: N // 2], source[: N // 2] + np.float32(3)])
    method = jr.ICP(jr.PointToPoint(), L2(), max_correspondence_distance=0.3)
    sol = jr.register(far, target, method, init=init)
    free = jr.register(far, target, jr.ICP(jr.PointToPoint(), L2()), init=init)
    assert pose_error(sol.T_target_source, T)[0] < 0.1
    assert pose_error(free.T_target_source, T)[0] > 0.2


@pytest.mark.parametrize("residual", [jr.PointToPoint(), jr.PlaneToPlane()])
def test_a_descent_limited_to_near_pairs_is_that_of_the_near_points(near, residual):
    """What lies beyond the largest distance might as well be masked."""
    source, target, _, init, _ = near
    far = np.concatenate([source[: N // 2], source[: N // 2] + np.float32(3)])

    def cloud(points: np.ndarray, num: int) -> PointCloud:
        normals = jnp.full(points.shape, 3**-0.5)
        return PointCloud(jnp.asarray(points), normals, jnp.arange(M) < num)

    source, target = np.resize(far, (M, 3)), cloud(target, M)
    index = BruteForce.build(target.points)
    problems = [Problem.of(cloud(source, num), target, index) for num in (N, N // 2)]
    limits = Limits(1, False, *map(jnp.float32, (0.3, 0.01, 1e-4)))
    optimiser = LocalOptimiser(residual, L2(), GaussNewton())
    T = jnp.asarray(init, jnp.float32)

    @jax.jit
    def pulls(problem):
        found = match(problem, T).within(limits.farthest)
        return residual.normal_equations(found, optimiser.weights(found, limits.floor))

    for found, expected in zip(*map(pulls, problems), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)
    assert float(jnp.linalg.norm(pulls(problems[1])[1])) > 1


def test_a_plane_on_a_plane_is_degenerate():
    sol = jr.register(_flat(N, 0), _flat(M, 1), jr.ICP(), init=np.eye(4))
    assert int(sol.status) == Status.DEGENERATE
    assert _finite(sol)


def test_an_end_worse_than_the_guess_is_reported_and_the_guess_returned(near):
    source, target, T, _, _ = near
    guess = motion(37, 3, angle=1.2, shift=1.5) @ T
    method = jr.ICP(jr.Symmetric(), L2(), max_steps=3)
    sol = jr.register(source, target, method, init=guess)
    assert int(sol.status) == Status.DIVERGED
    np.testing.assert_allclose(sol.T_target_source, guess, atol=1e-4)


@pytest.mark.parametrize("i", [0, 10])
def test_a_guess_that_fits_as_well_as_the_end_is_no_alarm(i):
    """At the truth, with samples of their own, ends are worse or better by chance."""
    scans, T, *_ = sculpture_scans(12, seed=0)
    target, source = (
        scans[k][:: len(scans[k]) // n][:n] for k, n in ((i, M), (i + 1, N))
    )
    sol = jr.register(source, target, jr.ICP(), init=np.linalg.inv(T[i]) @ T[i + 1])
    assert int(sol.status) == Status.CONVERGED
    assert sol.overlap > 0.5


@pytest.mark.parametrize("factor", [0.5, 20.0])
def test_scale_is_found_with_the_pose_if_asked(near, factor):
    source, target, T, _, _ = near
    method = jr.ICP(with_scale=True)
    sol = jr.register(np.float32(factor) * source, target, method)
    assert int(sol.status) == Status.CONVERGED
    block = np.asarray(sol.T_target_source, np.float64)[:3, :3] * factor
    np.testing.assert_allclose(block @ block.T, np.eye(3), atol=0.02)
    moved = move(np.asarray(sol.T_target_source), np.float32(factor) * source)
    assert np.abs(moved - move(T, source)).max() < 0.05
    # The guess's scale is taken from its block.
    start = np.diag(np.array([1 / factor] * 3 + [1], np.float32))
    again = jr.register(np.float32(factor) * source, target, method, init=start)
    np.testing.assert_allclose(again.T_target_source, sol.T_target_source, atol=0.02)


def test_steps_that_run_out_early_end_with_all_points():
    # Enough points that a descent begins with some of them.
    source, T = blob(2000, 3, seed=1), motion(3, 3, angle=0.6)
    target = move(T, blob(2000, 3, seed=2))
    sol = jr.register(source, target, jr.ICP(max_steps=3), init=np.eye(4))
    assert int(sol.status) == Status.MAX_STEPS
    start, _ = pose_error(jnp.eye(4), T)
    angle, _ = pose_error(sol.T_target_source, T)
    assert angle < 0.6 * start
    # The last match is of each point with its closest one: the energy is small.
    far = jr.correspondences(source, target, np.eye(4, dtype=np.float32)).sq_distance
    assert float(sol.error) < float(np.sum(far)) / 2


def test_without_asking_the_answer_is_rigid(near):
    source, target, _, init, _ = near
    sol = jr.register(np.float32(1.1) * source, target, jr.ICP(), init=init)
    block = np.asarray(sol.T_target_source)[:3, :3]
    np.testing.assert_allclose(block @ block.T, np.eye(3), atol=1e-5)


def _line(num: int) -> np.ndarray:
    return np.linspace(0, 1, num, dtype=np.float32)[:, None] * np.ones(3, np.float32)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (np.ones((N, 3), np.float32), {Status.TOO_FEW_POINTS}),
        (np.full((N, 3), np.nan, np.float32), {Status.TOO_FEW_POINTS}),
        (_line(N), {Status.DEGENERATE, Status.LOW_OVERLAP}),
        (
            np.repeat(blob(10, 3), N // 10, axis=0),
            {Status.CONVERGED, Status.LOW_OVERLAP, Status.MAX_STEPS},
        ),
        (blob(N, 3) + np.float32(1e9), set(Status)),
        (blob(N, 3) * np.float32(1e-20), set(Status)),
    ],
    ids=["one-place", "nan", "line", "duplicates", "far", "tiny"],
)
def test_poor_input_gets_a_status_and_a_finite_pose(source, expected):
    sol = jr.register(source, blob(M, 3, seed=2), jr.ICP(), init=np.eye(4))
    status = Status(int(sol.status))
    assert status in expected
    if status == Status.CONVERGED:
        assert _finite(sol)
        assert np.isfinite(float(sol.fitness))
        assert np.isfinite(float(sol.inlier_rmse))


def test_parts_that_do_nothing_are_refused():
    with pytest.raises(ValueError, match="max_steps"):
        jr.ICP(max_steps=0)
    with pytest.raises(ValueError, match="dimension"):
        jr.register(jnp.zeros((9, 2)), jnp.zeros((9, 3)), jr.ICP())
