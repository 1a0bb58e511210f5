import jax
import numpy as np
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxreg.graph import PoseGraph, trees
from jaxreg.graph.shortest_paths import shortest_paths


V, E = 12, 30
maximum = jax.jit(trees.maximum_spanning_tree, static_argnums=3)
shortest = jax.jit(shortest_paths, static_argnums=3)
components = jax.jit(trees.components, static_argnums=2)
ancestors = jax.jit(trees.ancestors)


def random_case(seed: int, present: float = 1.0):
    """Random edges (with repeats) of consistent motions, and the poses behind them."""
    rng = np.random.default_rng(seed)
    X = np.tile(np.eye(4), (V, 1, 1))
    X[:, :3, :3] = Rotation.from_quat(rng.normal(size=(V, 4))).as_matrix()
    X[:, :3, 3] = rng.normal(size=(V, 3))
    X = np.linalg.inv(X[0]) @ X
    i = rng.integers(0, V, E)
    edges = np.stack([i, (i + rng.integers(1, V, E)) % V], axis=1).astype(np.int32)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    weight = rng.uniform(0.1, 1, E) * (rng.uniform(size=E) < present)
    return X, edges, T.astype(np.float32), weight.astype(np.float32)


def scipy_components(edges: np.ndarray, weight: np.ndarray) -> np.ndarray:
    keep = weight > 0
    graph = sp.coo_matrix(
        (np.ones(keep.sum()), (edges[keep, 0], edges[keep, 1])), (V, V)
    )
    return sp.csgraph.connected_components(graph, directed=False)[1]


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(((a[:, None] == a) == (b[:, None] == b)).all())


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.2, 0.5, 1.0]))
def test_forest_is_that_of_scipy_and_poses_are_exact(seed, present):
    X, edges, T, weight = random_case(seed, present)
    forest = maximum(edges, T, weight, V)
    labels = scipy_components(edges, weight)
    component = components(edges, weight, V)
    assert same_partition(np.asarray(component), labels)
    assert same_partition(np.asarray(forest.component), labels)
    assert all(
        component[v] == min(np.flatnonzero(labels == labels[v])) for v in range(V)
    )
    np.testing.assert_array_equal(forest.reached, labels == labels[0])
    in_tree = np.asarray(forest.in_tree)
    assert in_tree.sum() == V - len(set(labels))
    # SciPy keeps one of parallel edges: build its input from the heaviest.
    dense = np.zeros((V, V))
    for (i, j), w in zip(edges.tolist(), weight.tolist(), strict=True):
        dense[i, j] = dense[j, i] = max(dense[i, j], w)
    cost = np.where(np.triu(dense) > 0, 2 - np.triu(dense), 0)
    tree = sp.csgraph.minimum_spanning_tree(cost)
    best = (2 - tree.data).sum() if tree.nnz else 0
    np.testing.assert_allclose(weight[in_tree].sum(), best, rtol=1e-5)
    expected = np.where((labels == labels[0])[:, None, None], X, np.eye(4))
    np.testing.assert_allclose(forest.T_world_i, expected, atol=2e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.2, 0.5, 1.0]))
def test_shortest_paths_reach_what_is_connected_exactly(seed, present):
    X, edges, T, weight = random_case(seed, present)
    paths = shortest(edges, T, weight, V, seed % V)
    root = seed % V
    labels = scipy_components(edges, weight)
    reached = labels == labels[root]
    np.testing.assert_array_equal(paths.reached, reached)
    T_root_i = np.linalg.inv(X[root]) @ X
    expected = np.where(reached[:, None, None], T_root_i, np.eye(4))
    np.testing.assert_allclose(paths.T_root_i, expected, atol=2e-5)
    # Each frame but the root comes by an edge from its parent.
    inner = reached & (np.arange(V) != root)
    ends = np.sort(edges[np.asarray(paths.via)[inner]], axis=1)
    steps = np.stack([np.flatnonzero(inner), np.asarray(paths.parent)[inner]], axis=1)
    np.testing.assert_array_equal(ends, np.sort(steps, axis=1))
    np.testing.assert_array_equal(paths.via == E, ~inner)
    above = np.asarray(ancestors(paths.parent))
    np.testing.assert_array_equal(above[reached, root], True)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 2, 8, 9, 16, 17]))
def test_ancestors_are_all_frames_above(seed, num):
    rng = np.random.default_rng(seed)
    # Frames below their parents, a chain among the cases, in any numbering.
    up = np.maximum(np.arange(num) - 1, 0)
    if seed % 2:
        up = rng.integers(0, up + 1)
    name = rng.permutation(num)
    parent = np.empty(num, np.int32)
    parent[name] = name[up]
    expected = np.zeros((num, num), bool)
    for i in range(num):
        at = i
        while not expected[i, at]:
            expected[i, at], at = True, parent[at]
    np.testing.assert_array_equal(ancestors(parent), expected)


def test_weights_below_a_thousandth_of_the_largest_count_as_that():
    edges = np.array([[0, 1], [1, 2], [0, 2], [0, 3]], np.int32)
    T = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    T[:3, 0, 3] = [1, 1, 10]
    # 301 by two steps against 900 by one; then 1200 against 5000, which counts as 1000.
    for length, expected in (((1, 300, 900, 1), 2), ((600, 600, 5000, 1), 10)):
        weight = 1 / np.array(length, np.float32)
        found = shortest(edges, T, weight, 4, 0)
        np.testing.assert_allclose(np.asarray(found.T_root_i)[2, 0, 3], expected)


def test_frames_that_follow_each_other_are_joined_first():
    # 0-1-2-3 of weight 1, closures of weight 1.5 that are wrong, and no edge 3-4.
    edges = np.array([[0, 1], [2, 1], [2, 3], [0, 2], [3, 1], [4, 0]], np.int32)
    T = np.tile(np.eye(3, dtype=np.float32), (6, 1, 1))
    T[:, 0, 2] = [1, -1, 1, 7, 7, 5]
    weight = np.array([1, 1, 1, 1.5, 1.5, 0.1], np.float32)
    graph = PoseGraph.from_edges(edges, T, weight=weight)
    x = np.asarray(jax.jit(trees.along_frames)(graph))[:, 0, 2]
    np.testing.assert_allclose(x, [0, 1, 2, 3, -5])


def test_paths_are_those_of_least_variance():
    # 0-1-2 of variance 1 each against a direct edge of variance 3, then of 1.5.
    T = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    T[:, 0, 3] = [1, 1, 10]
    edges = np.array([[0, 1], [1, 2], [0, 2]], np.int32)
    for direct, expected in ((3.0, 2.0), (1.5, 10.0)):
        weight = np.array([1, 1, 1 / direct], np.float32)
        poses = np.asarray(shortest(edges, T, weight, 3).T_root_i)
        np.testing.assert_allclose(poses[2, 0, 3], expected)


def test_ties_go_to_the_earlier_edge_and_direction_does_not_matter():
    T = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    T[:, 0, 3] = [1, 5, -2]
    edges = np.array([[0, 1], [0, 1], [2, 1]], np.int32)
    forest = maximum(edges, T, np.ones(3, np.float32), 3)
    np.testing.assert_allclose(np.asarray(forest.T_world_i)[:, 0, 3], [0, 1, 3])
    np.testing.assert_array_equal(forest.in_tree, [True, False, True])


def test_batches_and_long_chains():
    X, edges, T, weight = random_case(3)
    batch = jax.vmap(lambda w: maximum(edges, T, w, V).T_world_i)
    both = np.asarray(batch(np.stack([weight, weight[::-1]])))
    np.testing.assert_allclose(both[0], X, atol=2e-5)
    num = 2000
    chain = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1).astype(np.int32)
    steps = np.tile(np.eye(4, dtype=np.float32), (num - 1, 1, 1))
    steps[:, 0, 3] = 1
    ones = np.ones(num - 1, np.float32)
    poses = np.asarray(maximum(chain, steps, ones, num).T_world_i)
    np.testing.assert_array_equal(poses[:, 0, 3], np.arange(num))
    np.testing.assert_array_equal(components(chain, ones, num), 0)
    np.testing.assert_array_equal(shortest(chain, steps, ones, num).T_root_i, poses)
