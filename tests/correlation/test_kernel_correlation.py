"""`KernelCorrelation` against a NumPy objective and SciPy's optimiser."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from helpers import blob, motion, move
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import jaxreg as jr
from jaxreg import Status
from jaxreg.cloud import PointCloud
from jaxreg.correlation import KernelCorrelation, kernel_correlation
from jaxreg.registrar import Frames


N, M = 150, 200
WIDTH = 0.25
LANES = 64
T_COPY = motion(7, 2, angle=0.6, shift=0.2)


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


def _answer(T):
    return T[0, 2] + 2 * T[0, 0] - T[1, 0]


@pytest.fixture(scope="module")
def planar():
    """Curves in float64 without `register`: solutions and slopes of a batch.

    Independent samples in all lanes but the last, which holds a copy moved by T_COPY.
    """
    with jax.enable_x64(True):
        sources = np.stack([blob(N, 2, seed=2 * i) for i in range(LANES)])
        targets = np.stack([blob(M, 2, seed=2 * i + 1) for i in range(LANES)])
        sources, targets = sources.astype(float), targets.astype(float)
        targets[-1, :N] = move(T_COPY, sources[-1])
        masks = np.ones((LANES, M), bool)
        masks[-1, N:] = False

        @jax.jit
        @jax.vmap
        def solve(source: jax.Array, target: jax.Array, mask: jax.Array):
            def answer(source: jax.Array, target: jax.Array, width: jax.Array):
                # Without normals, which would be most of the compilation.
                sol = KernelCorrelation(width).solve(
                    PointCloud(source, 0 * source, jnp.ones(N, bool)),
                    PointCloud(target, 0 * target, mask),
                    None,
                )
                return _answer(sol.T_target_source), sol

            slope = jax.grad(answer, (0, 1, 2), has_aux=True)
            return slope(source, target, jnp.asarray(WIDTH))

        slopes, sol = jax.device_get(solve(sources, targets, masks))
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
    T = planar[2].T_target_source[:-1]
    covariance = planar[2].covariance[:-1]
    tangent = np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    predicted = np.sqrt(np.mean(covariance, axis=0).diagonal())
    found = np.sqrt(np.mean(tangent**2, axis=1))
    np.testing.assert_allclose(predicted, found, rtol=0.35)


def test_moved_copy_in_the_plane_is_recovered(planar):
    np.testing.assert_allclose(planar[2].T_target_source[-1], T_COPY, atol=1e-12)
    assert int(planar[2].status[-1]) == Status.CONVERGED
    assert planar[2].fitness[-1] == 1


def _register(source, target, init, width=WIDTH, **settings):
    method = KernelCorrelation(width, **settings)
    return jr.register(source, target, method, init=init)


def _padded(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.full((M - N, 3), np.nan, np.float32)])


@pytest.fixture(scope="module")
def copy():
    """A moved copy of a surface in float32: source, target, truth, guess."""
    T = motion(7, 3, angle=0.6)
    source = blob(N, 3, seed=1)
    return source, _padded(move(T, source)), T, motion(8, 3, 0.3, shift=0.1) @ T


def test_moved_copy_in_space_is_recovered_at_any_width(copy):
    source, target, T, init = copy
    for width in (0.2, 0.3, 0.5):
        sol = _register(source, target, init, width)
        assert int(sol.status) == Status.CONVERGED
        np.testing.assert_allclose(sol.T_target_source, T, atol=1e-5)
        assert float(sol.fitness) > 0.8
    assert {x.dtype for x in jax.tree.leaves(sol) if x.dtype.kind == "f"} == {
        np.dtype(np.float32)
    }


def test_optimum_is_that_of_scipy_in_space_and_in_any_unit():
    T = motion(5, 3, angle=0.4)
    source, target = move(np.linalg.inv(T), blob(N, 3, seed=1)), blob(M, 3, seed=2)
    init = motion(9, 3, 0.2, shift=0.1) @ T
    sol = _register(source, target, init)
    best = _best(T, source, target)
    np.testing.assert_allclose(sol.T_target_source, best, atol=3e-5)
    assert float(sol.error) == pytest.approx(_energy(best, source, target, WIDTH), 1e-4)

    unit = np.array([1000.0] * 3 + [1.0] * 3)
    init[:3, 3] *= 1000
    mm = _register(1000 * source, 1000 * target, init, 1000 * WIDTH)
    np.testing.assert_allclose(
        mm.covariance / np.outer(unit, unit), sol.covariance, rtol=0.01, atol=1e-6
    )
    np.testing.assert_allclose(mm.error, 1e6 * sol.error, rtol=1e-4)
    best[:3, 3] *= 1000
    np.testing.assert_allclose(mm.T_target_source, best, atol=0.03)


def test_bandwidth_is_a_length_of_the_input_or_a_share_of_the_target():
    frames = Frames(jnp.zeros(3), jnp.zeros(3), jnp.asarray(2.0))
    half = KernelCorrelation(0.5).in_frames(frames)
    assert float(jnp.asarray(half.bandwidth)) == 0.25
    own = KernelCorrelation().in_frames(frames)
    assert own.bandwidth is None
    fine, coarse = (float(own.width(jnp.asarray(x))) for x in (0.01, 0.2))
    assert fine == pytest.approx(0.2)
    assert coarse == pytest.approx(0.4)


def test_a_ring_turns_freely():
    turn = np.linspace(0, 2 * np.pi, N, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1).astype(np.float32)
    sol = _register(ring, _padded(ring), motion(1, 3, angle=0.2, shift=0.1))
    assert int(sol.status) == Status.DEGENERATE
    T = np.asarray(sol.T_target_source)
    np.testing.assert_allclose(T[:3, 3], 0, atol=1e-4)
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-4)


def test_failures_are_statuses(copy):
    source, target, _, init = copy
    endless = _register(source, target, init, tolerance=0.0)
    assert int(endless.status) == Status.MAX_STEPS
    away = np.eye(4)
    away[0, 3] = 1000
    sol = _register(source, target, away)
    assert int(sol.status) == Status.LOW_OVERLAP
    np.testing.assert_allclose(sol.T_target_source, away, atol=1e-3)
    one_place = np.ones_like(source)
    assert int(_register(one_place, target, init).status) == Status.TOO_FEW_POINTS
    nowhere = np.full((4, 4), np.nan)
    assert int(_register(source, target, nowhere).status) == Status.NON_FINITE


def test_settings_that_do_nothing_are_refused():
    for settings in ({"max_steps": 0}, {"max_points": 0}):
        with pytest.raises(ValueError, match="at least 1"):
            KernelCorrelation(**settings)
    for width in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="bandwidth"):
            KernelCorrelation(width)


@pytest.mark.parametrize(
    "solver",
    [optimistix.LevenbergMarquardt(1e-8, 1e-8), optimistix.BFGS(1e-8, 1e-8)],
    ids=lambda s: type(s).__name__,
)
def test_solvers_of_optimistix_end_at_the_best_pose(solver):
    source, target = blob(N, 2), blob(M, 2, seed=1)
    target = move(T_COPY, target)
    with jax.enable_x64(True):
        valid = [jnp.asarray(np.ones(n, bool)) for n in (N, M)]
        p, q = (jnp.asarray(x.astype(float)) for x in (source, target))
        zero = [jnp.asarray(np.zeros((n, 2))) for n in (N, M)]
        here, there = PointCloud(p, zero[0], valid[0]), PointCloud(q, zero[1], valid[1])
        method = KernelCorrelation(WIDTH, tolerance=1e-6, solver=solver)
        sol = eqx.filter_jit(method.solve)(here, there, None)
    assert sol.status == Status.CONVERGED
    best = _best(np.eye(3), source, target)
    assert np.abs(best - np.eye(3)).max() > 0.1
    np.testing.assert_allclose(sol.T_target_source, best, atol=1e-5)


def test_what_is_no_solver_is_refused():
    with pytest.raises(TypeError, match="KernelCorrelation: solver: wanted a minim"):
        KernelCorrelation(solver="BFGS")
