import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.averaging import CycleConsensus, average
from jaxreg.averaging.cycles import edge_log_odds
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors
from tests.averaging.graphs import random_graph


N, H = 16, 100
log_odds = jax.jit(edge_log_odds)


def single(X, edges, T, **kwargs) -> PoseGraph:
    return PoseGraph.from_edges(edges, T.astype(np.float32), len(X), **kwargs)


def naive_log_odds(X, edges, T) -> np.ndarray:
    """The message passing, cycle by cycle in float64."""
    at = {}
    for e, (i, j) in enumerate(edges.tolist()):
        at[i, j], at[j, i] = (e, T[e]), (e, np.linalg.inv(T[e]))
    length = np.linalg.norm(T[:, :3, 3], axis=1)
    low, high = np.sort(length)[[round(0.25 * (H - 1)), round(0.75 * (H - 1))]]
    scale = length[(length >= low) & (length <= high)].mean()
    prior = np.log(0.4 / 0.6)
    odds = np.full(H, prior)
    for _ in range(6):
        belief, new = 1 / (1 + np.exp(-odds)), np.full(H, prior)
        for e, (i, j) in enumerate(edges.tolist()):
            for k in range(len(X)):
                if (i, k) in at and (k, j) in at:
                    (a, A), (b, B) = at[i, k], at[k, j]
                    G = np.linalg.inv(T[e]) @ A @ B
                    sq = 3 - np.trace(G[:3, :3]) + (G[:3, 3] ** 2).sum() / scale**2
                    ratio = min((0.09 / (sq + 64 * 1.2e-7)) ** 2, 1e4)
                    both = belief[a] * belief[b]
                    new[e] += np.log(1 + both * (ratio - 1))
        odds = new
    return odds


def test_beliefs_against_a_loop_over_cycles():
    X, edges, T, bad = random_graph(N, H, 0.4, 0)
    odds = np.asarray(log_odds(single(X, edges, T)))
    np.testing.assert_allclose(odds, naive_log_odds(X, edges, T), rtol=2e-2, atol=0.1)
    assert odds[bad].max() < np.median(odds[~bad])


def test_beliefs_ignore_masked_edges_and_know_parallel_ones():
    X, edges, T, bad = random_graph(N, H, 0.3, 1)
    again = np.concatenate([edges, edges[:5]])
    motions = np.concatenate([T, T[:5]])
    mask = np.arange(H + 5) != 50
    odds = np.asarray(log_odds(single(X, again, motions, mask=mask)))
    assert odds[50] == -np.inf
    np.testing.assert_allclose(odds[H:], odds[:5], rtol=1e-3, atol=1e-3)


def test_graphs_too_large_for_cycles_keep_the_prior():
    num = 1100
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    T = np.tile(np.eye(4, dtype=np.float32), (num - 1, 1, 1))
    graph = PoseGraph.from_edges(edges, T)
    np.testing.assert_allclose(edge_log_odds(graph), np.log(0.4 / 0.6), rtol=1e-5)


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
    # A frame that is reached by contradicting edges alone cannot settle.
    wild = T.copy()
    at = (edges == 5).any(axis=1)
    R = Rotation.from_quat(np.random.default_rng(0).normal(size=(at.sum(), 4)))
    wild[at, :3, :3] = R.as_matrix()
    solution = average(single(X, edges, wild), CycleConsensus(), key=key)
    assert solution.num_steps == CycleConsensus().rounds
    with pytest.raises(ValueError, match="hypotheses: wanted at least 1"):
        CycleConsensus(hypotheses=0)
