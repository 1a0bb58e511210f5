import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.averaging.start.cycles import NEUTRAL, edge_log_odds
from jaxreg.averaging.start.long_cycles import long_cycle_odds
from jaxreg.graph import PoseGraph, trees
from jaxreg.metrics import rotation_errors
from tests.averaging.graphs import random_graph


@jax.jit
def long_odds(graph: PoseGraph) -> jax.Array:
    return long_cycle_odds(graph, edge_log_odds(graph)[0], jax.random.key(0))


@pytest.fixture(scope="module", params=[0, 1])
def case(request):
    X, edges, T, bad = random_graph(100, 400, 0.3, request.param)
    return X, PoseGraph.from_edges(edges, T.astype(np.float32), len(X)), bad


def test_cycles_close_through_right_edges_alone(case):
    _, graph, bad = case
    odds = np.asarray(long_odds(graph))
    assert odds.shape == (len(NEUTRAL), len(bad))
    assert np.mean(odds[0, ~bad] > 0) > 0.97
    assert not np.any(odds[:, bad] > 0)
    assert np.all(np.diff(odds, axis=0) <= 0)  # a closer fit is harder
    # Cycles of three say less: they leave right edges unconfirmed.
    assert np.mean(np.asarray(edge_log_odds(graph))[0, ~bad] > 0) < 0.9


def test_a_tree_of_confirmed_edges_places_the_frames_that_they_reach(case):
    X, graph, _ = case
    odds = long_odds(graph)[0]
    weight = jnp.where(odds > 0, odds, 0)
    tree = trees.maximum_spanning_tree(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    )
    assert np.sum(tree.reached) >= 95
    error = rotation_errors(tree.T_world_i, jnp.asarray(X, jnp.float32), "first")
    assert np.max(np.asarray(error)[np.asarray(tree.reached)]) < np.deg2rad(10)


def test_absent_edges_are_no_part_of_a_cycle(case):
    _, graph, bad = case
    some = np.arange(len(bad)) % 5 == 0
    masked = PoseGraph.from_edges(graph.edges, graph.T_i_j, graph.num_poses, mask=~some)
    odds = np.asarray(long_odds(masked))
    assert np.all(odds[:, some] == -np.inf)
    assert np.sum(odds[0] > 0) < np.sum(np.asarray(long_odds(graph))[0] > 0)
