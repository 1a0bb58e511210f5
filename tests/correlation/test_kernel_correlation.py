"""`KernelCorrelation` against a NumPy objective and SciPy's optimiser."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import jaxreg as jr
from jaxreg import Status
from jaxreg.cloud import PointCloud
from jaxreg.correlation import KernelCorrelation, kernel_correlation


N, M = 150, 200
WIDTH = 0.25
LANES = 64


def _energy(T: np.ndarray, source: np.ndarray, target: np.ndarray, width: float):
    sq = cdist(move(T, source.astype(float)), target.astype(float), "sqeuclidean")
    return float(np.sum(width**2 * -np.expm1(-sq / (2 * width**2))))


def _turned(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    """T with its rotation turned by x[d:] and its translation shifted by x[:d]."""
    d = len(T) - 1
    vector = [0, 0, x[2]] if d == 2 else x[3:]
    out = np.array(T, float)
    out[:d, :d] = Rotation.from_rotvec(vector).as_matrix()[:d, :d] @ T[:d, :d]
    out[:d, d] += x[:d]
    return out


def _best(
    T: np.ndarray, source: np.ndarray, target: np.ndarray, width: float = WIDTH
) -> np.ndarray:
    """The optimum next to T, by SciPy in float64."""

    def energy(x: np.ndarray) -> float:
        return _energy(_turned(T, x), source, target, width)

    found = minimize(energy, np.zeros(3 * len(T) - 6), method="BFGS", tol=1e-9)
    return _turned(T, found.x)


def _solve(source, target, init, width, target_mask=None):
    """Without thinning and normals, which would be most of the compilation."""
    mask = jnp.ones(len(target), bool) if target_mask is None else target_mask
    source_cloud = PointCloud(source, 0 * source, jnp.ones(len(source), bool))
    return KernelCorrelation(width).solve(
        source_cloud, PointCloud(target, 0 * target, mask), init
    )


def _answer(T):
    return T[0, 2] + 2 * T[0, 0] - T[1, 0]


@pytest.fixture(scope="module")
def planar():
    """Independent samples of a curve in float64, their solutions and slopes."""
    with jax.enable_x64(True):
        sources = np.stack([blob(N, 2, seed=2 * i) for i in range(LANES)])
        targets = np.stack([blob(M, 2, seed=2 * i + 1) for i in range(LANES)])
        sources, targets = sources.astype(float), targets.astype(float)

        @jax.jit
        @jax.vmap
        def solve(source: jax.Array, target: jax.Array):
            def answer(source: jax.Array, target: jax.Array, width: jax.Array):
                sol = _solve(source, target, None, width)
                return _answer(sol.T_target_source), sol

            slope = jax.grad(answer, (0, 1, 2), has_aux=True)
            return slope(source, target, jnp.asarray(WIDTH))

        slopes, sol = jax.device_get(solve(sources, targets))
    assert sol.H.dtype == sol.T_target_source.dtype == np.float64
    best = _best(np.eye(3), sources[0], targets[0])
    return sources, targets, sol, slopes, best


@pytest.mark.parametrize("d", [2, 3])
def test_value_is_the_sum_over_all_valid_pairs(d):
    source, target = blob(300, d, seed=1), blob(500, d, seed=2)
    masks = np.arange(300) % 7 > 0, np.arange(500) % 5 > 0
    sq = cdist(source.astype(float), target.astype(float), "sqeuclidean")
    k = np.exp(-sq / (2 * WIDTH**2))
    value = kernel_correlation(jnp.asarray(source), jnp.asarray(target), WIDTH)
    assert float(value) == pytest.approx(k.sum(), rel=1e-5)
    value = kernel_correlation(
        jnp.asarray(source), jnp.asarray(target), WIDTH, *map(jnp.asarray, masks)
    )
    assert float(value) == pytest.approx(k[masks[0]][:, masks[1]].sum(), rel=1e-5)


def _largest(jaxpr) -> int:
    """Elements of the largest array in a traced function and the functions within."""
    sizes = [0]
    for eqn in jaxpr.eqns:
        sizes += [out.aval.size for out in eqn.outvars]
        for param in eqn.params.values():
            inner = getattr(param, "jaxpr", param)
            if hasattr(inner, "eqns"):
                sizes.append(_largest(inner))
    return max(sizes)


def test_no_array_holds_all_pairs():
    x = jnp.asarray(blob(5000, 3))
    value = jax.make_jaxpr(kernel_correlation)(x, x, WIDTH)
    slope = jax.make_jaxpr(jax.grad(kernel_correlation, (0, 1, 2)))(x, x, WIDTH)
    assert 1000 < _largest(value.jaxpr) <= 1 << 17
    assert 1000 < _largest(slope.jaxpr) <= 1 << 17


def test_optimum_is_that_of_scipy_in_the_plane(planar):
    sources, targets, sol, _, best = planar
    assert np.all(sol.num_steps < 30)
    np.testing.assert_allclose(sol.T_target_source[0], best, atol=1e-6)
    energy = _energy(best, sources[0], targets[0], WIDTH)
    assert float(sol.error[0]) == pytest.approx(energy)


def test_curvature_is_that_of_the_objective(planar):
    sources, targets, sol, _, best = planar
    h, eye = 1e-3, np.eye(3)

    def energy(x: np.ndarray) -> float:
        return _energy(_turned(best, x), sources[0], targets[0], WIDTH)

    def mixed(a: np.ndarray, b: np.ndarray) -> float:
        same, other = h * (a + b), h * (a - b)
        total = energy(same) - energy(other) - energy(-other) + energy(-same)
        return total / (4 * h**2)

    H = np.array([[mixed(a, b) for a in eye] for b in eye])
    np.testing.assert_allclose(sol.H[0], H, atol=1e-3 * np.max(H))
    # The last step is what b leaves to be done.
    assert np.max(np.abs(np.linalg.solve(sol.H[0], sol.b[0]))) < 1e-4


def test_slopes_are_those_of_the_optimum(planar):
    sources, targets, _, slopes, best = planar
    source, target = sources[0], targets[0]
    rng, h = np.random.default_rng(0), 1e-3
    for k, noise in enumerate(
        (rng.standard_normal(source.shape), rng.standard_normal(target.shape), 1.0)
    ):
        ends = []
        for sign in (1, -1):
            args = [source, target, WIDTH]
            args[k] = args[k] + sign * h * noise
            ends.append(_answer(_best(best, *args)))
        slope = np.sum(slopes[k][0] * noise)
        assert slope == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-3)


def test_covariance_is_the_spread_of_the_answers_over_samples(planar):
    T, covariance = planar[2].T_target_source, planar[2].covariance
    tangent = np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    predicted = np.sqrt(np.mean(covariance, axis=0).diagonal())
    found = np.sqrt(np.mean(tangent**2, axis=1))
    np.testing.assert_allclose(predicted, found, rtol=0.35)


@pytest.fixture(scope="module")
def spatial():
    return jax.jit(_solve)


def test_optimum_is_that_of_scipy_in_space(spatial):
    source, target = blob(N, 3, seed=1), blob(M, 3, seed=2)
    init = motion(5, 3, angle=0.4, shift=0.1).astype(np.float32)
    sol = spatial(source, target, init, WIDTH, np.ones(M, bool))
    best = _best(np.eye(4), source, target)
    np.testing.assert_allclose(sol.T_target_source, best, atol=3e-5)
    assert {x.dtype for x in jax.tree.leaves(sol) if x.dtype.kind == "f"} == {
        np.dtype(np.float32)
    }


def test_moved_copy_in_space_is_recovered_at_any_width(spatial):
    T = motion(7, 3, angle=0.6, shift=0.2)
    source = blob(N, 3, seed=1)
    target = np.concatenate([move(T, source), source[: M - N]])
    for width in (0.2, 0.3, 0.5):
        sol = spatial(source, target, np.eye(4), width, np.arange(M) < N)
        assert int(sol.status) == Status.CONVERGED
        np.testing.assert_allclose(sol.T_target_source, T, atol=1e-5)
        assert float(sol.fitness) == 1


@pytest.fixture(scope="module")
def copy():
    T = motion(7, 2, angle=0.6)
    source = blob(N, 2, seed=1)
    target = np.concatenate([move(T, source), np.full((M - N, 2), np.nan, np.float32)])
    init = motion(8, 2, angle=0.3, shift=0.1) @ T
    return source, target, T, init


def _register(source, target, init, **settings) -> jr.RegistrationSolution:
    return jr.register(source, target, KernelCorrelation(**settings), init=init)


def test_moved_copy_in_the_plane_in_any_unit(copy):
    source, target, T, init = copy
    sol = _register(source, target, init)
    assert int(sol.status) == Status.CONVERGED
    assert pose_error(sol.T_target_source, T) == pytest.approx((0, 0), abs=1e-4)
    assert float(sol.fitness) == float(sol.overlap) == 1

    T_mm, unit = np.array(init), np.array([1000.0, 1000.0, 1.0])
    T_mm[:2, 2] *= 1000
    mm = _register(1000 * source, 1000 * target, T_mm)
    np.testing.assert_allclose(
        mm.covariance / np.outer(unit, unit), sol.covariance, rtol=0.01, atol=1e-7
    )
    np.testing.assert_allclose(mm.error, 1e6 * sol.error, rtol=1e-3)
    T_mm = np.array(mm.T_target_source)
    T_mm[:2, 2] /= 1000
    np.testing.assert_allclose(T_mm, sol.T_target_source, atol=1e-4)


def test_a_bandwidth_is_a_length_of_the_input():
    method = KernelCorrelation(0.5).in_unit(jnp.asarray(2.0))
    assert float(jnp.asarray(method.bandwidth)) == 0.25
    assert KernelCorrelation().in_unit(jnp.asarray(2.0)).bandwidth is None


def test_a_ring_turns_freely(copy):
    _, target, _, _ = copy
    turn = np.linspace(0, 2 * np.pi, N, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1).astype(np.float32)
    padded = np.concatenate([ring, np.full_like(target[N:], np.nan)])
    sol = _register(ring, padded, motion(1, 2, angle=0.2, shift=0.1))
    assert int(sol.status) == Status.DEGENERATE
    assert np.linalg.norm(sol.T_target_source[:2, 2]) < 1e-3


def test_failures_are_statuses(copy):
    source, target, _, init = copy
    assert (
        int(_register(source, target, init, tolerance=0.0).status) == Status.MAX_STEPS
    )
    away = motion(0, 2, angle=0, shift=0)
    away[0, 2] = 1000
    sol = _register(source, target, away)
    assert int(sol.status) == Status.LOW_OVERLAP
    np.testing.assert_allclose(sol.T_target_source, away, atol=1e-3)
    one_place = np.ones_like(source)
    assert int(_register(one_place, target, init).status) == Status.TOO_FEW_POINTS
    nowhere = np.full((3, 3), np.nan)
    assert int(_register(source, target, nowhere).status) == Status.NON_FINITE


def test_settings_that_do_nothing_are_refused():
    for settings in ({"max_steps": 0}, {"max_points": 0}):
        with pytest.raises(ValueError, match="at least 1"):
            KernelCorrelation(**settings)
    for width in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="bandwidth"):
            KernelCorrelation(width)
