from itertools import accumulate

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.averaging import CycleConsensus, PoseGraphLM, average
from jaxreg.averaging.start.cycles import NEUTRAL, ROUNDS, edge_log_odds, judged
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error, rotation_errors
from tests.averaging.graphs import (
    motions,
    noisy_grid,
    random_graph,
    rotations,
)


N, H = 16, 100
log_odds = jax.jit(edge_log_odds)


def single(X, edges, T, **kwargs) -> PoseGraph:
    return PoseGraph.from_edges(edges, T.astype(np.float32), len(X), **kwargs)


def naive_log_odds(X, edges, T, neutral) -> np.ndarray:
    """The message passing, cycle by cycle in float64."""
    at = {}
    for e, (i, j) in enumerate(edges.tolist()):
        at[i, j], at[j, i] = (e, T[e]), (e, np.linalg.inv(T[e]))
    length = np.linalg.norm(T[:, :3, 3], axis=1)
    low, high = np.sort(length)[[round(0.25 * (H - 1)), round(0.75 * (H - 1))]]
    scale = length[(length >= low) & (length <= high)].mean()
    odds = np.zeros(H)
    for _ in range(ROUNDS):
        belief, new = 1 / (1 + np.exp(-odds)), np.zeros(H)
        for e, (i, j) in enumerate(edges.tolist()):
            for k in range(len(X)):
                if (i, k) in at and (k, j) in at:
                    (a, A), (b, B) = at[i, k], at[k, j]
                    G = np.linalg.inv(T[e]) @ A @ B
                    sq = 3 - np.trace(G[:3, :3]) + (G[:3, 3] ** 2).sum() / scale**2
                    ratio = max((neutral**2 / max(sq, 0.5**16)) ** 3, 0.3)
                    both = belief[a] * belief[b]
                    new[e] += np.log(1 + both * (ratio - 1))
        odds = new
    return odds


def test_beliefs_against_a_loop_over_cycles():
    X, edges, T, bad = random_graph(N, H, 0.4, 0)
    odds = np.asarray(log_odds(single(X, edges, T)))
    for row, neutral in zip(odds, NEUTRAL, strict=True):
        naive = naive_log_odds(X, edges, T, neutral)
        np.testing.assert_allclose(row, naive, rtol=2e-2, atol=0.1)
    assert odds[0, bad].max() < np.median(odds[0, ~bad])


def test_beliefs_ignore_masked_edges_and_know_parallel_ones():
    X, edges, T, bad = random_graph(N, H, 0.3, 1)
    again = np.concatenate([edges, edges[:5]])
    motions = np.concatenate([T, T[:5]])
    mask = np.arange(H + 5) != 50
    odds = np.asarray(log_odds(single(X, again, motions, mask=mask)))
    assert (odds[:, 50] == -np.inf).all()
    np.testing.assert_allclose(odds[:, H:], odds[:, :5], rtol=1e-3, atol=1e-3)


def test_graphs_too_large_for_cycles_take_short_paths_or_the_heaviest_tree():
    num = 1100
    rng = np.random.default_rng(0)
    X = np.tile(np.eye(4), (num, 1, 1))
    X[1:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(num - 1, 3))).as_matrix()
    X[1:, :3, 3] = rng.normal(size=(num - 1, 3))
    # Every frame is seen from the first, and wrongly, so the weights say, from before.
    to = np.arange(1, num)
    edges = np.concatenate([np.stack([0 * to, to], 1), np.stack([to - 1, to], 1)[1:]])
    T = np.concatenate([X[1:], np.tile(np.eye(4), (num - 2, 1, 1))])
    weight = np.where(np.arange(len(edges)) < num - 1, 1.0, 0.1).astype(np.float32)
    graph = single(X, edges, T, weight=weight)
    assert not judged(graph, CycleConsensus().max_cycles)
    found = average(graph, CycleConsensus()).T_world_i
    np.testing.assert_allclose(found, X, atol=1e-4)


@pytest.mark.parametrize("outliers", [0.0, 0.5])
def test_a_start_near_the_truth_with_half_of_the_motions_wrong(outliers):
    misses = 0
    for seed in range(10):
        X, edges, T, _ = random_graph(N, H, outliers, seed)
        solution = average(single(X, edges, T), CycleConsensus(), key=jax.random.key(0))
        true = jnp.asarray(X, jnp.float32)
        errors = rotation_errors(solution.T_world_i, true)
        misses += float(jnp.max(errors)) > np.deg2rad(8)
        again = average(single(X, edges, T), CycleConsensus(), key=jax.random.key(0))
        np.testing.assert_array_equal(solution.T_world_i, again.T_world_i)
    assert misses <= 1


def test_settled_graphs_need_no_hypotheses():
    X, edges, T, _ = random_graph(N, H, 0.0, 0)
    key = jax.random.key(0)
    assert average(single(X, edges, T), CycleConsensus(), key=key).num_steps == 0
    # Nor do those with wrong motions, though noise leaves few edges at fine scales.
    for seed in range(20):
        _, ids, noisy, _ = random_graph(N, H, 0.3, seed)
        solution = average(single(X, ids, noisy), CycleConsensus(), key=key)
        assert solution.num_steps == 0
    # A frame that is reached by contradicting edges alone cannot settle.
    wild = T.copy()
    at = (edges == 5).any(axis=1)
    R = Rotation.from_quat(np.random.default_rng(0).normal(size=(at.sum(), 4)))
    wild[at, :3, :3] = R.as_matrix()
    solution = average(single(X, edges, wild), CycleConsensus(), key=key)
    assert solution.num_steps > 0
    with pytest.raises(ValueError, match="hypotheses: wanted an integer of at least 1"):
        CycleConsensus(hypotheses=0)


def test_a_search_ends_where_many_trees_meet():
    drawn = [random_graph(24, 100, 0.2, seed) for seed in range(2)]
    for X, edges, T, _ in drawn:
        graph = PoseGraph.from_edges(edges, T.astype(np.float32), 24)
        found = average(graph, CycleConsensus())
        assert 0 < found.num_steps < 8
        truth = jnp.asarray(X, jnp.float32)
        assert rotation_error(found.T_world_i, truth, "best") < 0.1
    # Where nothing agrees it goes on until half of its rounds have gained nothing.
    _, edges, T, _ = drawn[0]
    wild = T[np.random.default_rng(0).permutation(len(T))].astype(np.float32)
    found = average(PoseGraph.from_edges(edges, wild, 24), CycleConsensus())
    assert found.num_steps >= 8


def test_gains_of_rounding_keep_no_search_going():
    # With half of few edges wrong the first round finds what can be found, and poses
    # that settle once more gain thousandths in every round.
    for seed in range(3):
        X, edges, T, _ = random_graph(12, 46, 0.5, seed)
        found = average(single(X, edges, T), CycleConsensus())
        assert 0 < found.num_steps <= 9


def test_noise_alone_is_not_taken_for_outliers():
    X, edges, T = noisy_grid(4, 0)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32))
    truth = jnp.asarray(X, jnp.float32)
    least_squares = average(graph, PoseGraphLM()).T_world_i
    for key in map(jax.random.key, range(2)):  # the first as without a key
        found = average(graph, key=key)
        assert np.mean(np.asarray(found.edge_weight) > 0.5) > 0.9
        error = rotation_error(found.T_world_i, truth, "best")
        assert error < 1.2 * rotation_error(least_squares, truth, "best")


def test_wrong_motions_of_a_noisy_grid_are_found():
    rng = np.random.default_rng(0)
    X, edges, T = noisy_grid(4, 0, noise=0.4)
    wrong = rng.choice(len(edges), len(edges) // 10, replace=False)
    T[wrong] = motions(
        rotations(rng, len(wrong), 3, None), rng.uniform(-1.5, 1.5, (len(wrong), 3))
    )
    bad = np.isin(np.arange(len(edges)), wrong)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32))
    kept = PoseGraph.from_edges(edges, T.astype(np.float32), mask=~bad)
    truth = jnp.asarray(X, jnp.float32)
    oracle = rotation_error(average(kept, PoseGraphLM()).T_world_i, truth, "best")
    for key in map(jax.random.key, range(2)):  # the first as without a key
        found = average(graph, key=key)
        trusted = np.asarray(found.edge_weight) > 0.5
        assert np.mean(trusted[~bad]) > 0.85
        assert not trusted[bad].any()
        assert rotation_error(found.T_world_i, truth, "best") < 1.2 * oracle


def test_a_false_closure_is_told_from_a_false_step_under_it():
    num, trusted, wrong = 24, [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        step = motions(
            rotations(rng, num - 1, 3, 0.3), np.eye(3)[np.zeros(num - 1, int)]
        )
        X = np.array(list(accumulate(step, np.matmul, initial=np.eye(4))))
        ends = [sorted(rng.choice(num, 2, replace=False)) for _ in range(4)]
        steps = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
        edges = np.concatenate([steps, ends])
        noise = 0.01 * rng.normal(size=(len(edges), 3))
        noise = motions(rotations(rng, len(edges), 3, 0.01), noise)
        T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ noise
        false = rng.permutation(4)[:2] + num - 1
        T[false] = motions(rotations(rng, 2, 3, None), rng.uniform(-5, 5, (2, 3)))
        order = rng.permutation(len(edges))
        graph = PoseGraph.from_edges(edges[order], T[order].astype(np.float32))
        trusted.append(np.asarray(average(graph).edge_weight) > 0.5)
        wrong.append(np.isin(order, false))
    np.testing.assert_array_equal(~np.array(trusted), np.array(wrong))
