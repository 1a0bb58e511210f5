import jax
import numpy as np
import pytest

from jaxreg._core.status import Status
from jaxreg.averaging import LowRankSparse, average
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


N, H = 12, 60


def naive_split(T, edges, scale: float) -> np.ndarray:
    """The same minimum, with the best rank-4 matrix of each turn by SVD."""
    X, seen = np.zeros((N, N, 4, 4)), np.eye(N, dtype=bool)
    X[np.arange(N), np.arange(N)] = np.eye(4)
    for (i, j), M in zip(edges, T, strict=True):
        X[i, j] = np.where(np.arange(4) < 3, M, M / scale)
        X[i, j, 3, 3] = 1
        X[j, i] = np.linalg.inv(X[i, j])
        seen[i, j] = seen[j, i] = True
    L = np.zeros((4 * N, 4 * N))
    for _ in range(500):
        gap = X - L.reshape(N, 4, N, 4).transpose(0, 2, 1, 3)
        norm = np.linalg.norm(gap, axis=(2, 3))
        share = seen * np.minimum(0.05 / np.maximum(norm, 1e-12), 1)
        rest = L + (share[:, :, None, None] * gap).transpose(0, 2, 1, 3).reshape(
            L.shape
        )
        U, s, Vt = np.linalg.svd(rest)
        L = (U[:, :4] * s[:4]) @ Vt[:4]
    poses = []
    for block in L[:, :4].reshape(N, 4, 4) @ np.linalg.inv(L[:4, :4]):
        U, _, Vt = np.linalg.svd(block[:3, :3])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = U @ Vt, scale * block[:3, 3]
        poses.append(np.linalg.inv(pose))
    return np.stack(poses)


def test_the_split_against_singular_values_in_numpy():
    X, edges, T, bad = random_graph(N, H, 0.2, 0)
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T)
        solution = average(graph, LowRankSparse(tolerance=1e-10))
        expected = naive_split(T, edges, float(graph.length_scale))
    assert solution.status == Status.CONVERGED
    np.testing.assert_allclose(solution.T_world_i, expected, atol=1e-6)
    np.testing.assert_allclose(solution.T_world_i, X, atol=0.1)
    weight = np.asarray(solution.edge_weight)
    assert weight[bad].max() < 0.5 < weight[~bad].min()


@pytest.mark.parametrize("d", [2, 3])
def test_exact_motions_twice_and_once_are_recovered(d):
    X, edges, T, _ = random_graph(N, H, 0.0, 1, d=d, noise=0.0)
    again = np.concatenate([edges, edges[:5, ::-1]])
    motions = np.concatenate([T, np.linalg.inv(T[:5])])
    graph = PoseGraph.from_edges(again, motions, N)
    solution = average(graph, LowRankSparse())
    np.testing.assert_allclose(solution.T_world_i, X, atol=2e-4)


def test_large_graphs_are_refused():
    edges = np.stack([np.arange(200), np.arange(1, 201)], axis=1)
    graph = PoseGraph.from_edges(edges, np.tile(np.eye(4), (200, 1, 1)))
    with pytest.raises(ValueError, match="wanted at most 128 poses, found 201"):
        average(graph, LowRankSparse())
