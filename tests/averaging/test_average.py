import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from jaxreg._core.status import Status
from jaxreg.averaging import (
    MCC,
    AveragingSolution,
    Correntropy,
    MotionAveraging,
    RootRows,
    ShortestPaths,
    SpanningTree,
    WeightedMotionAveraging,
    WeightRows,
    average,
)
from jaxreg.averaging.steps.gauss_newton import (
    gauss_newton_step,
)
from jaxreg.averaging.steps.gradients import gauss_newton_gradients
from jaxreg.averaging.steps.iterate import iterate
from jaxreg.averaging.steps.kernel_width import gaussian_trust, width_rule
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error, translation_error
from tests.averaging.graphs import random_graph


N, H = 12, 60
METHODS = {
    "tree": SpanningTree(),
    "paths": ShortestPaths(),
    "plain": MotionAveraging(),
    "weighted": WeightedMotionAveraging(),
    "correntropy": MCC(initialiser=SpanningTree()),
    "annealed": Correntropy(),
}


def single(X, edges, T, weight=None, **kwargs) -> PoseGraph:
    return PoseGraph.from_edges(edges, T.astype(np.float32), len(X), weight, **kwargs)


def errors(solution: AveragingSolution, X: np.ndarray) -> tuple[float, float]:
    true = jnp.asarray(X, solution.T_world_i.dtype)
    T = solution.T_world_i
    return float(rotation_error(T, true)), float(translation_error(T, true))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", METHODS)
def test_exact_motions_are_recovered_exactly_at_any_gauge(name, d):
    X, edges, T, _ = random_graph(N, H, 0.0, 0, d=d, noise=0.0)
    graph = single(X, edges, T)
    solution = average(graph, METHODS[name])
    assert solution.status == Status.CONVERGED
    assert max(errors(solution, X)) < 1e-5
    assert solution.residual < 1e-5
    assert solution.T_world_i.dtype == jnp.float32
    np.testing.assert_array_equal(solution.T_world_i[0], np.eye(d + 1))
    np.testing.assert_allclose(solution.edge_weight, 1, atol=0.8)
    if d == 2 or name not in ("plain", "annealed"):
        return
    gauge = X[3] @ X
    moved = average(graph, METHODS[name], init=gauge)
    np.testing.assert_allclose(moved.T_world_i, gauge, atol=2e-5)


@pytest.mark.parametrize("name", ["plain", "annealed"])
def test_order_direction_and_unit_of_the_motions_do_not_matter(name):
    X, edges, T, bad = random_graph(N, H, 0.1, 1)
    with jax.enable_x64(True):
        method = METHODS[name]
        init = X + 0.0
        base = average(PoseGraph.from_edges(edges, T), method, init=init)
        order = np.random.default_rng(0).permutation(H)
        swapped = np.where(
            (order % 2 == 0)[:, None], edges[order][:, ::-1], edges[order]
        )
        inverted = np.where(
            (order % 2 == 0)[:, None, None], np.linalg.inv(T[order]), T[order]
        )
        other = average(PoseGraph.from_edges(swapped, inverted), method, init=init)
        # Swapping i and j changes which end measures the translation: a share of the
        # noise (9e-3) for methods that weigh rotation and translation apart.
        tolerance = {"plain": 1e-6, "annealed": 5e-3}[name]
        np.testing.assert_allclose(other.T_world_i, base.T_world_i, atol=tolerance)
        mm = np.diag([1e3, 1e3, 1e3, 1])
        scaled = mm @ T @ np.linalg.inv(mm)
        start = mm @ init @ np.linalg.inv(mm)
        other = average(PoseGraph.from_edges(edges, scaled), method, init=start)
        np.testing.assert_allclose(
            other.T_world_i, mm @ base.T_world_i @ np.linalg.inv(mm), atol=1e-6
        )
        np.testing.assert_allclose(other.edge_weight, base.edge_weight, atol=1e-8)
        np.testing.assert_allclose(other.residual, base.residual, rtol=1e-8)


def vec(T: np.ndarray) -> np.ndarray:
    m = np.real(logm(T))
    return np.array([*m[:3, 3], m[2, 1], m[0, 2], m[1, 0]])


def rvec(v: np.ndarray) -> np.ndarray:
    m = np.zeros((4, 4))
    m[:3, 3] = v[:3]
    m[2, 1], m[0, 2], m[1, 0] = v[3:]
    return expm(m - np.pad(m[:3, :3].T, (0, 1)))


@pytest.mark.parametrize("rows", [RootRows(), WeightRows()])
@pytest.mark.parametrize("kind", ["weighted", "correntropy"])
def test_one_step_against_the_stacked_system_of_the_paper(rows, kind):
    X, edges, T, _ = random_graph(N, H, 0.1, 2)
    rng = np.random.default_rng(0)
    init = np.stack([rvec(0.05 * rng.normal(size=6)) @ x for x in X])
    init = np.linalg.inv(init[0]) @ init
    prior = rng.uniform(0.5, 2, H)
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, weight=prior)
        if kind == "weighted":
            method = WeightedMotionAveraging(rows=rows, max_steps=1)
        else:
            method = MCC(alpha=0.8, rows=rows, max_steps=1)
        solution = average(graph, method, init=init)
    w = prior.copy()
    if kind == "correntropy":
        scale = float(solution.length_scale)
        gaps = T - np.linalg.inv(init[edges[:, 0]]) @ init[edges[:, 1]]
        gaps[:, :3, 3] /= scale
        e = np.sqrt((gaps**2).sum((1, 2)))
        sigma = 0.8 * (prior * e).sum() / prior.sum()
        w = prior * np.exp(-(e**2) / (2 * sigma**2))
    row = np.sqrt(w) if isinstance(rows, RootRows) else w
    D, dV = np.zeros((6 * H, 6 * N)), np.zeros(6 * H)
    for h, (i, j) in enumerate(edges):
        at = slice(6 * h, 6 * h + 6)
        D[at, 6 * i : 6 * i + 6] = -row[h] * np.eye(6)
        D[at, 6 * j : 6 * j + 6] = row[h] * np.eye(6)
        dV[at] = row[h] * vec(init[i] @ T[h] @ np.linalg.inv(init[j]))
    A = np.linalg.lstsq(D[:, 6:], dV, rcond=None)[0].reshape(-1, 6)
    expected = np.stack([rvec(a) @ M for a, M in zip(A, init[1:], strict=True)])
    np.testing.assert_allclose(solution.T_world_i[1:], expected, atol=2e-6)


@pytest.mark.parametrize(
    ("name", "outliers", "limit"), [("correntropy", 0.1, 1.15), ("annealed", 0.4, 1.05)]
)
def test_outliers_hardly_matter(name, outliers, limit):
    """The median over seeds is near that of the oracle that knows the inliers.

    The published width is started at the truth, the default from the motions alone.
    """
    robust, oracle = [], []
    best = METHODS["plain" if name == "correntropy" else "annealed"]
    for seed in range(10):
        X, edges, T, bad = random_graph(N, H, outliers, seed)
        start = None if name == "annealed" else X
        found = average(single(X, edges, T), METHODS[name], start)
        assert found.status == Status.CONVERGED
        robust.append(errors(found, X))
        kept = single(X, edges, T, mask=~bad)
        oracle.append(errors(average(kept, best, start), X))
    ratio = np.median(robust, axis=0) / np.median(oracle, axis=0)
    assert (ratio < limit).all(), ratio


def test_kernel_width_is_three_deviations_of_the_noise():
    found = []
    for seed in range(5):
        X, edges, T, _ = random_graph(N, H, 0.3, seed)
        found.append(average(single(X, edges, T), METHODS["annealed"]).kernel_width)
    width = np.median(found, axis=0)
    np.testing.assert_allclose(width, [3 * 0.005, 3 * np.deg2rad(0.5)], rtol=0.2)


@pytest.mark.parametrize("width", [(0.04, 0.08), (0.08, 0.04)])
def test_the_next_width_is_solved_from_the_mean_square_inside_the_present_one(
    width: tuple[float, float],
):
    # Of 100 edges 56 hold exactly, the others are as far off as the kernel is wide: not
    # normal noise, of which the middle edge would tell as much as the mean.
    num, exact = 100, 56
    rng = np.random.default_rng(0)
    X, edges, _, _ = random_graph(15, num, 0.0, 0)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    axis, shift = rng.normal(size=(2, num, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    shift /= np.linalg.norm(shift, axis=1, keepdims=True)
    off = (np.arange(num) >= exact)[:, None]
    T[:, :3, :3] = (
        T[:, :3, :3] @ Rotation.from_rotvec(width[1] * off * axis).as_matrix()
    )
    T[:, :3, 3] += width[0] * off * shift
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), 15)
    poses = jnp.asarray(X, jnp.float32)
    begin, no = jnp.asarray(width, jnp.float32), jnp.asarray(False)
    held = width_rule(jnp.asarray(1.0), begin, no, ~no)(graph, poses, begin)
    np.testing.assert_array_equal(held, begin)
    found = width_rule(jnp.asarray(1.0), begin, no, no)(graph, poses, begin)
    # Gaussian weights: each kind of error at one width, so exp(-1/2) of either.
    trust = np.exp(-1.0)
    count = exact + (num - exact) * trust
    square = (num - exact) * trust / 3 / count  # of a component, in widths
    ratio, spare = 1 / (1 / square - 1), count - 14
    ratio = ratio * count / spare
    assert 9 * ratio < 1
    shift, turn = ratio * np.square(width)
    # One edge says that translations are off by no less, as the unit is one.
    shift = max(shift, (spare * shift + turn) / (spare + 1))
    np.testing.assert_allclose(found, 3 * np.sqrt([shift, turn]), rtol=2e-3)


def test_edge_weights_name_the_outliers():
    X, edges, T, bad = random_graph(N, H, 0.4, 3)
    solution = average(single(X, edges, T), METHODS["annealed"])
    weight = np.asarray(solution.edge_weight)
    assert weight[bad].max() < weight[~bad].min()
    assert "trusted" in repr(solution)


def test_the_trace_tells_how_the_kernel_narrowed_and_the_steps_came_to_rest():
    X, edges, T, _ = random_graph(N, H, 0.4, 3)
    method = METHODS["annealed"]
    solution = average(single(X, edges, T), method)
    trace = solution.trace
    assert trace is not None
    num = int(trace.num_rows)
    assert num == int(solution.num_steps) > 1
    for rows in (trace.change, trace.kernel_width, trace.trust):
        assert len(rows) == method.max_steps
        assert not np.any(rows[num:])
    width = np.asarray(trace.kernel_width[:num])
    # It halves at most, and settles where it is three deviations, less than that above.
    lowest = np.minimum.accumulate(width)
    assert (width[1:] >= 0.499 * width[:-1]).all()
    assert (width <= 2.001 * lowest).all()
    np.testing.assert_array_equal(width[-1], solution.kernel_width)
    assert trace.change[num - 1] < 1e-5 < trace.change[0]
    trust = float(jnp.mean(solution.edge_weight))
    np.testing.assert_allclose(trace.trust[num - 1], trust, atol=1e-4)
    assert average(single(X, edges, T), METHODS["paths"]).trace is None


def test_gradients_agree_with_differences():
    """At a fixed kernel width, since widths are cut from the gradient."""
    X, edges, T, _ = random_graph(N, H, 0.05, 4)
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, weight=rng.uniform(0.5, 1.5, H))
        probe = rng.normal(size=(N, 4, 4))
        init = jnp.asarray(X)
        dT = np.zeros_like(T)
        dT[:, :3, 3] = rng.normal(size=(H, 3))
        dw = rng.normal(size=H)

        def value(x):
            g = PoseGraph.from_edges(
                edges, graph.T_i_j + x * dT, N, graph.weight + x * dw
            )
            end = iterate(
                g,
                init,
                jnp.array([0.05, 0.1]),
                lambda g, T, width: width,
                gaussian_trust,
                gauss_newton_step,
                max_steps=200,
                tolerance=1e-13,
            )
            end = gauss_newton_gradients(g, end, gaussian_trust)
            return jnp.sum(probe * end.T_world_i)

        h = 1e-6
        every = jax.jit(jax.vmap(jax.value_and_grad(value)))
        (_, up, down), slope = every(jnp.asarray([0.0, h, -h]))
        np.testing.assert_allclose((up - down) / (2 * h), slope[0], rtol=1e-5)


def test_gradients_are_finite_without_noise_and_follow_the_gauge():
    X, edges, T, _ = random_graph(N, H, 0.0, 4, noise=0.0)
    start = jnp.asarray(X, jnp.float32)

    @jax.jit
    @jax.grad
    def slope(args):
        T, weight, init = args
        graph = PoseGraph.from_edges(edges, T, N, weight)
        return jnp.sum(average(graph, METHODS["annealed"], init=init).T_world_i ** 2)

    by = slope((jnp.asarray(T, jnp.float32), jnp.ones(H), start))
    assert all(np.isfinite(x).all() for x in by)
    assert np.abs(by[0]).max() > 0
    assert np.abs(by[2][0]).max() > 0
    assert np.abs(by[2][1:]).max() == 0


def test_parts_that_hang_apart_are_told():
    X, edges, T, _ = random_graph(N, H, 0.0, 5, noise=0.0)
    cut = (edges < 8).all(axis=1) | (edges >= 8).all(axis=1)
    graph = single(X, edges, T, mask=cut)
    for name in ("paths", "annealed"):
        solution = average(graph, METHODS[name])
        assert solution.status == Status.DISCONNECTED
        np.testing.assert_array_equal(solution.placed, np.arange(N) < 8)
        np.testing.assert_allclose(solution.T_world_i[:8], X[:8], atol=1e-5)
        np.testing.assert_array_equal(
            solution.T_world_i[8:], np.eye(4)[None].repeat(4, axis=0)
        )
    zero = single(X, edges, T, weight=cut.astype(np.float32))
    assert average(zero, METHODS["annealed"]).status == Status.DISCONNECTED


def test_numbers_that_are_not_finite_cost_their_edge_alone():
    X, edges, T, _ = random_graph(N, H, 0.0, 6, noise=0.0)

    @jax.jit
    def solve(T, init):
        graph = PoseGraph.from_edges(edges, T, N)
        return average(graph, METHODS["plain"], init=init)

    broken = T.astype(np.float32)
    broken[7] = np.nan
    start = X.astype(np.float32)
    solution = solve(broken, start)
    assert solution.status == Status.NON_FINITE
    np.testing.assert_allclose(solution.T_world_i, X, atol=1e-5)
    assert solution.edge_weight[7] == 0
    start[4] = np.inf
    solution = solve(T.astype(np.float32), start)
    assert solution.status == Status.NON_FINITE
    np.testing.assert_allclose(solution.T_world_i, X, atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("length", "weight"), [(1e30, 1e38), (1e-30, 1e-37)])
def test_lengths_and_weights_may_be_of_any_size(name, length, weight):
    X, edges, T, _ = random_graph(N, H, 0.0, 6, noise=0.0)
    usual = average(single(X, edges, T), METHODS[name])
    T = T.copy()
    T[:, :3, 3] *= length
    found = average(single(X, edges, T, np.full(len(T), weight)), METHODS[name])
    assert found.status == usual.status
    assert np.max(rotation_error(found.T_world_i, usual.T_world_i)) < 0.01
    shift = found.T_world_i[:, :3, 3] / length - usual.T_world_i[:, :3, 3]
    assert np.max(np.abs(shift)) < 0.01 * np.max(np.abs(usual.T_world_i[:, :3, 3]))
    ratio = found.kernel_width[0] / usual.kernel_width[0]
    assert np.isinf(usual.kernel_width[0]) or abs(ratio / length - 1) < 0.5
    np.testing.assert_allclose(found.edge_weight, usual.edge_weight, atol=0.05)


@pytest.mark.parametrize("name", METHODS)
def test_a_weight_that_vanishes_beside_the_others_still_joins(name):
    X, edges, T, _ = random_graph(N, H, 0.0, 6, noise=0.0)
    weight = np.where(np.arange(len(T)) % 2, 1e38, 1e-37)
    found = average(single(X, edges, T, weight), METHODS[name])
    assert found.placed.all()
    assert errors(found, X)[0] < 0.01


def test_of_contradicting_measurements_of_a_pair_the_right_one_is_trusted():
    X, edges, T, _ = random_graph(N, H, 0.0, 8)
    wild = random_graph(N, H, 0.0, 9)[2]
    again, twice = edges.copy(), T.copy()
    again[-6:], twice[-6:] = edges[:6], wild[:6]
    solution = average(single(X, again, twice), METHODS["annealed"])
    assert errors(solution, X)[0] < np.deg2rad(0.5)
    trust = np.asarray(solution.edge_weight)
    assert trust[-6:].max() < 0.01
    assert trust[:6].min() > 0.1


def test_one_pose_no_edges_and_running_out_of_steps():
    empty = PoseGraph.from_edges([], np.zeros((0, 4, 4), np.float32), num_poses=1)
    for name in ("paths", "annealed"):
        solution = average(empty, METHODS[name])
        assert solution.status == Status.CONVERGED
        np.testing.assert_array_equal(solution.T_world_i[0], np.eye(4))
    X, edges, T, _ = random_graph(N, H, 0.1, 7)
    solution = average(single(X, edges, T), MotionAveraging(max_steps=1))
    assert solution.status == Status.MAX_STEPS
    assert solution.num_steps == 1


def test_wrong_arguments_are_named():
    X, edges, T, _ = random_graph(N, H, 0.0, 0)
    graph = single(X, edges, T)
    with pytest.raises(ValueError, match=r"init: wanted shape \(12, 4, 4\)"):
        average(graph, init=X[:3])
