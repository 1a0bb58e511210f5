import jax
import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jaxreg._core.status import Status
from jaxreg.averaging import MotionAveraging, average, pose_covariances
from jaxreg.averaging.measures import deviations
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import motions, random_graph, rotations


N, H = 8, 20
PLAIN = MotionAveraging()


def test_components_are_named_and_edges_counted():
    X, edges, T, bad = random_graph(N, H, 0.0, 0, noise=0.0)
    side = np.isin(edges, [1, 4, 6])
    cut = side.all(axis=1) | ~side.any(axis=1)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), N, mask=cut)
    solution = average(graph, PLAIN)
    i, j = edges[cut].T
    count, label = connected_components(csr_array((np.ones(len(i)), (i, j)), (N, N)))
    assert count > 1
    first = [np.flatnonzero(label == part).min() for part in label]
    np.testing.assert_array_equal(solution.component, first)
    np.testing.assert_array_equal(solution.placed, label == label[0])
    assert solution.status == Status.DISCONNECTED
    assert f"({count} components)" in repr(solution)
    assert solution.agreement == 1


def test_edges_in_any_order_twice_and_both_ways_count_as_measurements():
    """At the solution the flows of all measurements balance at each frame."""
    X, edges, T, _ = random_graph(N, H, 0.0, 2, noise=5.0)
    pick = np.array([3, 3, 7])
    twice = np.concatenate([edges, edges[pick[:2]], edges[pick[2:], ::-1]])
    again = np.concatenate([T, T[pick[:2]], np.linalg.inv(T[pick[2:]])])
    order = np.random.default_rng(0).permutation(len(twice))
    with jax.enable_x64(True):
        many = PoseGraph.from_edges(twice[order], again[order], N)
        found = average(many, PLAIN).T_world_i
        step = jax.jit(PoseGraph.residual_motions)(many, found)
        balance = np.zeros((N, 3))
        for (i, j), G in zip(twice[order], np.asarray(step), strict=True):
            turn = np.array([G[2, 1] - G[1, 2], G[0, 2] - G[2, 0], G[1, 0] - G[0, 1]])
            sine = np.linalg.norm(turn) / 2
            turn = turn / 2 * np.arcsin(sine) / sine
            balance[i] -= turn
            balance[j] += turn
        np.testing.assert_allclose(balance[1:], 0, atol=1e-7)


def test_the_length_scale_is_the_mean_of_the_middle_half():
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (41, 1, 1))
    T[:, :3, 3] = rng.standard_normal((41, 3)) * 10 ** rng.uniform(-1, 3, (41, 1))
    edges = np.stack([np.arange(41), np.arange(1, 42)], axis=1)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32)).padded(60)
    length = np.sort(np.linalg.norm(T[:, :3, 3], axis=1))
    np.testing.assert_allclose(graph.length_scale, length[10:31].mean(), rtol=1e-5)


def test_frames_that_no_edge_names_are_not_placed():
    X, edges, T, _ = random_graph(N, H, 0.0, 3, noise=0.0)
    spread = np.array([0, 3, 4, 9, 10, 17, 18, 30])
    graph = PoseGraph.from_edges(spread[edges], T.astype(np.float32))
    solution = average(graph, PLAIN)
    assert solution.T_world_i.shape == (31, 4, 4)
    assert solution.status == Status.DISCONNECTED
    np.testing.assert_array_equal(np.flatnonzero(solution.placed), spread)
    np.testing.assert_allclose(solution.T_world_i[spread], X, atol=1e-4)
    assert solution.component[5] == 5


def jacobian(X: np.ndarray, edges: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Of the errors by right tangents of frames 1, 2, ..., by central differences."""
    h = 1e-6

    def errors(X):
        gap = np.linalg.inv(T) @ np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
        return np.concatenate([gap[:, :2, 2], gap[:, 1, :1]], axis=1).ravel()

    generators = np.zeros((3, 3, 3))
    generators[0, 0, 2] = generators[1, 1, 2] = generators[2, 1, 0] = 1
    generators[2, 0, 1] = -1
    columns = []
    for v in range(1, N):
        for G in generators:
            up, down = X.copy(), X.copy()
            up[v], down[v] = X[v] @ (np.eye(3) + h * G), X[v] @ (np.eye(3) - h * G)
            columns.append((errors(up) - errors(down)) / (2 * h))
    return np.stack(columns, axis=1)


def test_covariances_against_the_inverse_of_a_numerical_hessian():
    X, edges, T, _ = random_graph(N, H, 0.0, 4, d=2, noise=0.0)
    rng = np.random.default_rng(0)
    half = rng.normal(size=(H, 3, 3))
    information = np.eye(3) + half @ half.swapaxes(1, 2)
    weight = rng.uniform(0.5, 2, H)
    J = jacobian(X, edges, T).reshape(H, 3, -1)
    hessian = np.einsum("eab,e,eac,ecd->bd", J, weight, information, J)
    expected = np.linalg.inv(hessian).reshape(N - 1, 3, N - 1, 3)
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, N, weight, information)
        solution = average(graph, PLAIN, init=X)
        covariance = pose_covariances(graph, solution)
    np.testing.assert_array_equal(covariance[0], 0)
    for v in range(1, N):
        np.testing.assert_allclose(
            covariance[v], expected[v - 1, :, v - 1], rtol=1e-4, atol=1e-8
        )


def test_covariances_without_information_are_those_of_the_errors_made():
    """Over repetitions, squared errors are as large as the covariances say."""
    rng = np.random.default_rng(1)
    X, edges, T, _ = random_graph(N, H, 0.0, 4, d=2, noise=0.0)
    ratios = []
    for _ in range(40):
        noise = motions(rotations(rng, H, 2, 0.01), 0.02 * rng.normal(size=(H, 2)))
        graph = PoseGraph.from_edges(edges, (T @ noise).astype(np.float32), N)
        solution = average(graph, PLAIN)
        covariance = np.asarray(pose_covariances(graph, solution))[1:]
        gap = (np.linalg.inv(X) @ np.asarray(solution.T_world_i, float))[1:]
        error = np.concatenate([gap[:, :2, 2], gap[:, 1, :1]], axis=1)
        ratios.append(
            np.einsum("va,vab,vb->v", error, np.linalg.inv(covariance), error)
        )
    assert 2.3 < np.mean(ratios) < 4.5  # 3 unknowns; plain averaging is not optimal


@pytest.mark.parametrize("d", [2, 3])
def test_deviations_are_those_of_the_noise_of_one_component(d):
    rng = np.random.default_rng(d)
    noise = motions(rotations(rng, 3000, d, 0.01), 0.05 * rng.normal(size=(3000, d)))
    edges = np.tile([0, 1], (3000, 1))
    graph = PoseGraph.from_edges(edges, noise.astype(np.float32))
    poses = np.broadcast_to(np.eye(d + 1, dtype=np.float32), (2, d + 1, d + 1))
    found = jax.jit(deviations)(graph, poses, np.ones(3000, np.float32))
    np.testing.assert_allclose(found, [0.05, 0.01], rtol=0.05)


def test_covariances_refuse_large_graphs_and_mark_loose_frames():
    num = 6000 // 6 + 1
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    graph = PoseGraph.from_edges(edges, np.tile(np.eye(4), (num - 1, 1, 1)))
    solution = jax.eval_shape(lambda g: average(g, PLAIN), graph)
    with pytest.raises(ValueError, match="wanted at most 1000 poses for covariances"):
        jax.eval_shape(pose_covariances, graph, solution)
    X, edges, T, _ = random_graph(N, H, 0.0, 4, d=2, noise=0.0)
    loose = (edges == N - 1).any(axis=1)
    weight = np.where(loose, 0, 1)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), N, weight)
    covariance = pose_covariances(graph, average(graph, PLAIN))
    assert np.isnan(covariance[-1]).all()
    assert np.isfinite(covariance[:-1]).all()
