import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import Status
from jaxreg.averaging import average
from jaxreg.graph import PoseGraph
from jaxreg.io import read_g2o
from jaxreg.linear.laplacian import DENSE_LIMIT
from jaxreg.metrics import align_poses, chordal_objective, translation_errors
from tests.averaging.graphs import crooked_path, motions, rotations
from tests.helpers import data_dir


LAP, LAPS = 50, 4


def laps_with_false_closures(seed: int):
    """Laps around a circle of radius 8 m, seen again each lap; true poses, graph."""
    rng = np.random.default_rng(seed)
    num = LAP * LAPS
    angle = 2 * np.pi * np.arange(num) / LAP
    c, s = np.cos(angle), np.sin(angle)
    R = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    X = motions(R, 8 * np.stack([s, 1 - c], axis=1))
    first = np.arange(num - LAP)
    chain = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    closures = np.stack([first, first + LAP], axis=1)
    true = np.concatenate([chain, closures])
    noise = motions(
        rotations(rng, len(true), 2, 0.01), 0.02 * rng.normal(size=(len(true), 2))
    )
    T = np.linalg.inv(X[true[:, 0]]) @ X[true[:, 1]] @ noise
    i, j = np.triu_indices(num, num // 20)
    pairs = np.stack([i, j], axis=1)
    pairs = pairs[(i - j) % LAP != 0]
    count = len(closures) // 5
    pairs = pairs[rng.choice(len(pairs), count, replace=False)]
    copied = len(chain) + rng.choice(len(closures), count, replace=False)
    edges = np.concatenate([true, pairs])
    graph = PoseGraph.from_edges(
        edges,
        np.concatenate([T, T[copied]]).astype(np.float32),
        num,
        information=np.tile(
            np.diag([2500, 2500, 1e4]).astype(np.float32), (len(edges), 1, 1)
        ),
    )
    return X, graph, np.arange(len(edges)) >= len(true)


@jax.jit
def farthest(T: jax.Array, true: jax.Array) -> jax.Array:
    """The largest error of a place, once poses are aligned."""
    return jnp.max(translation_errors(align_poses(T, true, "best"), true))


def test_false_closures_of_a_large_graph_are_found():
    for seed in range(2):
        X, graph, false = laps_with_false_closures(seed)
        assert graph.num_poses > DENSE_LIMIT
        solution = average(graph)
        assert solution.status == Status.CONVERGED
        trace = solution.trace
        assert trace is not None
        num = int(trace.num_rows)
        assert 1 < num <= int(solution.num_steps)
        width = np.asarray(trace.kernel_width[: num - 1])
        assert width[-1, 0] < 0.5 * width[0, 0]
        away = farthest(solution.T_world_i, X.astype(np.float32))
        assert float(away) < 0.3
        trusted = np.asarray(solution.edge_weight) > 0.5
        # Neighbouring places look alike to within the last width of the kernel.
        assert np.mean(trusted[false]) < 0.1
        assert np.mean(trusted[~false]) > 0.99


@pytest.mark.parametrize("told", [True, False])
def test_closures_of_a_path_that_hardly_resists_are_told_apart(told: bool):
    # Along a hundred steps a turn by a right angle is a degree at each.
    for seed in range(3):
        graph, wrong = crooked_path(seed, 300, 30, 9, told)
        solution = average(graph)
        np.testing.assert_array_equal(np.asarray(solution.edge_weight) < 0.5, wrong)
    # Steps without closures over them hold all but exactly: they tell nothing of noise.
    graph, _ = crooked_path(0, 300, 30, 0, told)
    few = np.arange(graph.num_edges) < 299 + 5
    graph = dataclasses.replace(graph, weight=graph.weight * few)
    trusted = np.asarray(average(graph).edge_weight) > 0.5
    assert trusted[few].all()


@pytest.mark.data
def test_few_closures_of_a_long_path_are_not_taken_for_outliers():
    # 20 closures; the path drifts by half a building.
    graph = read_g2o(data_dir("pose_graphs", "MIT.g2o"))
    solution = average(graph)
    assert solution.status == Status.CONVERGED
    assert np.mean(np.asarray(solution.edge_weight) > 0.5) > 0.995
    assert chordal_objective(graph, solution.T_world_i) < 1.1 * 61.1541
