import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

import jaxreg as jr
from jaxreg import Status
from jaxreg.averaging import CycleConsensus, MotionAveraging, average
from jaxreg.averaging.likelihood import Likelihood, least_after_fitting
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import (
    folding_graph,
    motions,
    random_graph,
    rotations,
)


N, H = 10, 25
log_evidence = eqx.filter_jit(lambda graph, T: Likelihood.of(graph).log_evidence(T))
explained = eqx.filter_jit(lambda graph, T: Likelihood.of(graph).explained(T))


def single(edges, T, num: int, **kwargs) -> PoseGraph:
    return PoseGraph.from_edges(edges, T.astype(np.float32), num, **kwargs)


def naive(X, edges, T, weight, dimension, deviations, sequence=False) -> float:
    """Log Lambda, edge by edge in float64; of a sequence near may be successive."""
    d, k = X.shape[-1] - 1, 3 * X.shape[-1] - 6
    length = np.linalg.norm(T[:, :d, d], axis=1)
    low, high = np.sort(length)[[round(q * (len(T) - 1)) for q in (0.25, 0.75)]]
    scale = length[(length >= low) & (length <= high)].mean()
    sq, far = [], {}
    for e, (i, j) in enumerate(edges.tolist()):
        P = np.linalg.inv(X[i]) @ X[j]
        D = (P - T[e]) ** 2
        sq.append(D[:d, :d].sum() / 2 + D[:d, d].sum() / scale**2)
        far[e] = d - np.trace(P[:d, :d]) + (P[:d, d] ** 2).sum() / scale**2
    rank = [
        min(
            sum(far[f] < far[e] for f, ends in enumerate(edges.tolist()) if end in ends)
            for end in edges[e].tolist()
        )
        for e in far
    ]
    volume = {
        2: 2 * np.pi * np.pi * 1.5**2,
        3: 8 * np.pi**2 * 4 / 3 * np.pi * (4 / 3) ** 3,
    }[d]
    reach = volume ** (1 / k) / np.sqrt(2 * np.pi)
    near_ways = [np.array(rank) < t for t in (4, 8)]
    if sequence:
        near_ways.append(np.abs(np.diff(edges, axis=1))[:, 0] == 1)
    odds = [-4.5, -3, -1.5, 0, 1.5, 3, 4.5]
    prior = weight / np.sort(weight)[round(0.5 * (len(weight) - 1))]
    terms = []
    for s in deviations:
        gain = (reach / s) ** dimension * np.exp(-np.array(sq) / (2 * s**2))
        for is_near in near_ways:
            for near in odds[3:]:
                for beyond in (x for x in odds if x <= near):
                    o = np.exp(np.where(is_near, near, beyond)) * prior
                    each = np.log((1 + o * gain) / (1 + o)).sum()
                    free = len(np.unique(edges)) - 1
                    terms.append(each - free * dimension * np.log(reach / s))
    return float(logsumexp(terms) - np.log(len(terms)))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("outliers", [0.1, 0.5])
def test_against_a_sum_over_edges_and_shares(d, outliers):
    X, edges, T, _ = random_graph(N, H, outliers, 0, d=d)
    weight = np.random.default_rng(0).uniform(0.2, 3, H)
    graph = single(edges, T, N, weight=weight.astype(np.float32))
    for poses in (X, random_graph(N, H, 0.0, 1, d=d)[0]):
        of = jnp.asarray(poses, jnp.float32)
        ladder = 0.5 / 2.0 ** np.arange(8)
        k = {2: 3, 3: 6}[d]
        expected = naive(poses, edges, T, weight, k, ladder[1:])
        np.testing.assert_allclose(log_evidence(graph, of), expected, rtol=2e-3)
        expected = naive(poses, edges, T, weight, 0.8, ladder)
        found = explained(graph, of)
        np.testing.assert_allclose(found.log_ratio, expected, rtol=2e-3, atol=1e-2)


@pytest.mark.parametrize("steps", [8, 6])
def test_steps_of_a_sequence_may_be_what_is_near(steps):
    X, _, _, _ = random_graph(N, H, 0.0, 0)
    first = np.arange(steps)
    closures = [[0, 3], [2, 5], [1, 6], [0, 7], [3, 7], [2, 9], [8, 5]]
    edges = np.concatenate([np.stack([first, first + 1], axis=1), closures])
    rng = np.random.default_rng(0)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    T[-3:-1] = motions(rotations(rng, 2, 3, None), rng.uniform(-1, 1, (2, 3)))
    found = explained(single(edges, T, N), jnp.asarray(X, jnp.float32))
    one, ladder = np.ones(len(edges)), 0.5 / 2.0 ** np.arange(8)
    expected = naive(X, edges, T, one, 0.8, ladder, sequence=steps > len(closures))
    np.testing.assert_allclose(found.log_ratio, expected, rtol=2e-3, atol=1e-2)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), unit=st.sampled_from([1e-3, 1.0, 25.4]))
def test_numbers_unit_and_a_common_motion_do_not_matter(seed, unit):
    rng = np.random.default_rng(seed)
    X, edges, T, _ = random_graph(N, H, 0.4, seed)
    base = log_evidence(single(edges, T, N), jnp.asarray(X, jnp.float32))
    name, order = rng.permutation(N), rng.permutation(H)
    G = random_graph(3, 3, 0.0, seed)[0][1]
    other = np.zeros_like(X)
    other[name] = G @ X
    other, moved = other.copy(), T[order].copy()
    other[:, :3, 3] *= unit
    moved[:, :3, 3] *= unit
    again = single(name[edges[order]], moved, N)
    found = log_evidence(again, jnp.asarray(other, jnp.float32))
    np.testing.assert_allclose(found, base, rtol=5e-3, atol=0.05)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_tree_has_no_evidence(seed):
    rng = np.random.default_rng(seed)
    X = random_graph(N, H, 0.0, seed)[0]
    to = np.arange(1, N)
    edges = np.stack([rng.integers(0, to), to], axis=1)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    weight = rng.uniform(0.1, 5, N - 1).astype(np.float32)
    graph = single(edges, T, N, weight=weight)
    for poses in (X, random_graph(N, H, 0.0, seed + 1)[0]):
        assert log_evidence(graph, jnp.asarray(poses, jnp.float32)) <= 1e-3


def test_absent_edges_count_nothing():
    X, edges, T, bad = random_graph(N, H, 0.3, 2)
    true = jnp.asarray(X, jnp.float32)
    kept = log_evidence(single(edges[~bad], T[~bad], N), true)
    masked = average(single(edges, T, N, mask=~bad), MotionAveraging()).log_evidence
    found = average(single(edges[~bad], T[~bad], N), MotionAveraging()).log_evidence
    np.testing.assert_allclose(masked, found, rtol=1e-4)
    assert kept > log_evidence(single(edges, T, N), true) > 0


def test_the_likeliest_deviation_and_the_odds_are_those_of_right_edges():
    X, edges, T, bad = random_graph(32, 465, 0.5, 0)
    found = explained(single(edges, T, 32), jnp.asarray(X, jnp.float32))
    # 0.5 degrees, and 0.5 % of a size that is about a length scale.
    assert 0.01 < found.deviation < 0.05
    np.testing.assert_array_equal(np.asarray(found.log_odds) > 0, ~bad)


def test_of_the_agreed_edges_those_of_a_tree_do_not_count():
    X, edges, T, bad = random_graph(32, 200, 0.3, 0)
    graph, true = single(edges, T, 32), jnp.asarray(X, jnp.float32)
    found = explained(graph, true)
    share = Likelihood.of(graph).agreed_share(found)
    assert share == pytest.approx((np.sum(~bad) - 31) / (200 - 31), abs=1e-6)
    # Terms r^2 / (2 s^2) of right edges have the variance D / 2; each is right nearly
    # for sure.
    chance = np.sqrt(0.8 / 2 * np.sum(~bad))
    least = least_after_fitting(found)
    assert float(found.log_ratio - least) == pytest.approx(chance, rel=0.05)


def test_near_views_tell_the_truth_from_a_larger_group_of_wrong_motions():
    for seed in range(3):
        X, folded, edges, T = folding_graph(seed)
        graph = single(edges, T, len(X))
        true, wrong = (jnp.asarray(P, jnp.float32) for P in (X, folded))
        assert log_evidence(graph, wrong) > log_evidence(graph, true)
        assert explained(graph, true).log_ratio > explained(graph, wrong).log_ratio


METHODS = [
    jr.Correntropy(),
    # As by default, but for the start.
    jr.Correntropy(initialiser=jr.SpanningTree()),
    jr.MCC(),
    MotionAveraging(),
    jr.WeightedMotionAveraging(),
    jr.PoseGraphLM(),
    jr.LowRankSparse(),
    jr.SpanningTree(),
    jr.ShortestPaths(),
]


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_random_motions_agree_with_no_method(method):
    for seed in range(5):
        X, edges, _, _ = random_graph(N, 28, 0.0, seed)
        rng = np.random.default_rng(seed)
        wild = motions(rotations(rng, 28, 3, None), rng.uniform(-1, 1, (28, 3)))
        found = average(single(edges, wild, N), method)
        assert found.status == Status.NO_AGREEMENT
        assert found.log_evidence <= 0
        right = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
        wild[4:] = right[4:]
        assert average(single(edges, wild, N), method).status != Status.NO_AGREEMENT


def test_where_nothing_agrees_the_status_says_so():
    X, edges, T, _ = random_graph(N, H, 0.0, 3)
    found = average(single(edges, T, N))
    assert found.status == Status.CONVERGED
    assert found.log_evidence > 100
    wild = random_graph(N, H, 0.0, 4)[2][np.random.default_rng(0).permutation(H)]
    found = average(single(edges, wild, N))
    assert found.status == Status.NO_AGREEMENT
    assert found.log_evidence <= 0
    assert "agree" in Status.NO_AGREEMENT.advice
    # Poses are those of the start, trust how probable edges are if it is right.
    start = average(single(edges, wild, N), CycleConsensus()).T_world_i
    np.testing.assert_allclose(found.T_world_i, start, atol=1e-5)
    graph = single(edges, wild, N)
    odds = Likelihood.of(graph).explained(start, alone=True).log_odds
    np.testing.assert_allclose(found.edge_weight, jax.nn.sigmoid(odds), atol=1e-3)
    # A tree has no edge to spare.
    edges[: N - 1] = np.stack([np.arange(N - 1), np.arange(1, N)], axis=1)
    chain = single(edges, wild, N, mask=np.arange(H) < N - 1)
    assert average(chain).status == Status.CONVERGED
