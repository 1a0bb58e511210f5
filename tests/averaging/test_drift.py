"""Closures against the drift of the frames between their ends."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from jaxreg.averaging.start import drift
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import motions, rotations


NUM, CLOSURES = 160, 40
TURN, SHIFT = 0.004, 0.01
# Compiled once: all graphs of a dimension have the same number of edges.
squared_misclosures = eqx.filter_jit(drift.squared_misclosures)
drifted = eqx.filter_jit(drift.drifted)


def walk(seed: int, dim: int = 3):
    """Edges and noisy motions of a crooked path with closures, and the deviations.

    The first frames of some edges are the later ones.
    """
    rng = np.random.default_rng(seed)
    step = motions(rotations(rng, NUM, dim, 0.2), np.eye(dim)[:1].repeat(NUM, 0))
    X = [np.eye(dim + 1)]
    for T in step[1:]:
        X.append(X[-1] @ T)
    X = np.array(X)
    low = rng.integers(0, NUM - 12, CLOSURES)
    high = np.minimum(low + rng.integers(10, 90, CLOSURES), NUM - 1)
    chain = np.stack([np.arange(NUM - 1), np.arange(1, NUM)], axis=1)
    edges = np.concatenate([chain, np.stack([low, high], axis=1)])
    edges[::3] = edges[::3, ::-1]
    turns = np.zeros((len(edges), 3))
    turns[:, 3 - dim * (dim - 1) // 2 :] = TURN
    R = Rotation.from_rotvec(turns * rng.normal(size=turns.shape)).as_matrix()
    shifts = SHIFT * rng.normal(size=(len(edges), dim))
    noise = motions(R[:, :dim, :dim], shifts)
    return edges, np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ noise


def graph_of(
    edges, T, weight=None, told: bool = True, dtype: type = np.float64
) -> PoseGraph:
    dim = T.shape[-1] - 1
    each = np.repeat([SHIFT**-2, TURN**-2], [dim, dim * (dim - 1) // 2])
    information = np.tile(np.diag(each).astype(dtype), (len(edges), 1, 1))
    weight = None if weight is None else weight.astype(dtype)
    of = information if told else None
    return PoseGraph.from_edges(edges, T.astype(dtype), NUM, weight, of)


def expected(edges, T) -> np.ndarray:
    """The same, one closure and one step after another."""
    dim = T.shape[-1] - 1
    each = np.repeat([SHIFT**2, TURN**2], [dim, dim * (dim - 1) // 2])
    steps = {}

    def adjoint(M):
        return np.asarray(lie.adjoint(jnp.asarray(M)))

    def forward(e):
        (i, j), M, C = edges[e], T[e], np.diag(each)
        if i < j:
            return M, C
        A = adjoint(M)
        return np.linalg.inv(M), A @ C @ A.T

    for e in range(NUM - 1):
        steps[min(edges[e])] = forward(e)
    found = []
    for e in range(NUM - 1, len(edges)):
        path, spread = np.eye(dim + 1), np.zeros((len(each), len(each)))
        for frame in range(min(edges[e]), max(edges[e])):
            M, C = steps[frame]
            A = adjoint(np.linalg.inv(M))
            path, spread = path @ M, A @ spread @ A.T + C
        M, C = forward(e)
        r = np.asarray(lie.log(jnp.asarray(np.linalg.inv(M) @ path)))
        found.append(r @ np.linalg.solve(spread + C, r))
    return np.array(found)


@pytest.mark.parametrize("dim", [2, 3])
def test_squares_are_those_of_covariances_carried_step_by_step(dim: int):
    edges, T = walk(0, dim)
    with jax.enable_x64(True):
        squares, known = squared_misclosures(graph_of(edges, T))
        assert known.all()
        wanted = expected(edges, T)
    np.testing.assert_allclose(squares[NUM - 1 :], wanted, rtol=1e-5)
    single, _ = squared_misclosures(graph_of(edges, T, dtype=np.float32))
    np.testing.assert_allclose(single[NUM - 1 :], wanted, rtol=0.05)


def test_squares_of_right_closures_follow_the_chi_squared_law():
    squares = [
        squared_misclosures(graph_of(*walk(seed), dtype=np.float32))[0][NUM - 1 :]
        for seed in range(100)
    ]
    # Closures of one path share steps.
    below = scipy.stats.chi2(6).cdf(np.concatenate(squares))
    for share in (0.25, 0.5, 0.75, 0.95):
        assert abs(np.mean(below < share) - share) < 0.05


@pytest.mark.parametrize("told", [True, False])
def test_false_closures_are_off_by_more_than_drift(told: bool):
    edges, T = walk(1)
    rng = np.random.default_rng(2)
    wrong = np.zeros(len(edges), bool)
    wrong[NUM - 1 + rng.choice(CLOSURES, 16, replace=False)] = True
    # By a turn of some degrees, and as far as the drift of fifty steps or so.
    error = motions(rotations(rng, 16, 3, 0.15), 1.5 * rng.normal(size=(16, 3)))
    T[wrong] = T[wrong] @ error
    closure = jnp.arange(len(edges)) >= NUM - 1
    found = np.asarray(
        drifted(graph_of(edges, T, told=told, dtype=np.float32), closure)
    )
    assert not found[~wrong].any()
    assert found[wrong].mean() > 0.9


def test_a_false_step_is_not_laid_on_the_closures_over_it():
    edges, T = walk(3)
    at = 20
    over = (edges.min(axis=1) <= at) & (edges.max(axis=1) > at)
    assert 4 < over[NUM - 1 :].sum() < CLOSURES / 2
    T[at] = T[at] @ motions(np.eye(3)[None], np.array([[0.0, 9.0, 0.0]]))[0]
    closure = jnp.arange(len(edges)) >= NUM - 1
    graph = graph_of(edges, T, dtype=np.float32)
    squares, _ = squared_misclosures(graph)
    assert (np.asarray(squares)[NUM - 1 :][over[NUM - 1 :]] > 30).all()
    assert not drifted(graph, closure).any()
    # Where others over that step fit, those that do not are false.
    fits = np.zeros(len(edges), bool)
    fits[np.flatnonzero(over)[-1]] = True
    T[fits] = np.linalg.inv(expected_motion(edges, T, fits))
    found = np.asarray(drifted(graph_of(edges, T, dtype=np.float32), closure))
    np.testing.assert_array_equal(found[NUM - 1 :], (over & ~fits)[NUM - 1 :])


def expected_motion(edges, T, which) -> np.ndarray:
    """The inverse of the motion of one edge as the steps have it."""
    (i, j), path = edges[which][0], np.eye(4)
    for frame in range(min(i, j), max(i, j)):
        M = T[frame]
        path = path @ (M if edges[frame, 0] == frame else np.linalg.inv(M))
    return (np.linalg.inv(path) if i < j else path)[None]


def test_a_closure_over_a_missing_step_is_not_judged():
    edges, T = walk(1)
    weight = np.ones(len(edges))
    weight[30] = 0
    T[NUM - 1 :] = T[NUM - 1 :] @ motions(
        np.eye(3)[None], np.linspace(0, 9, CLOSURES)[:, None] * np.ones((1, 3))
    )
    graph = graph_of(edges, T, weight, dtype=np.float32)
    over = (edges.min(axis=1) <= 30) & (edges.max(axis=1) > 30)
    _, known = squared_misclosures(graph)
    np.testing.assert_array_equal(known, ~over)
    found = np.asarray(drifted(graph, jnp.arange(len(edges)) >= NUM - 1))
    assert not found[over].any()
    assert found.any()


def test_what_edges_do_not_measure_allows_any_drift():
    edges, T = walk(1)
    T[NUM - 1 :] = T[NUM - 1 :] @ motions(
        np.eye(3)[None], 20 * np.random.default_rng(0).normal(size=(CLOSURES, 3))
    )
    graph = graph_of(edges, T, dtype=np.float32)
    assert graph.information is not None
    of_turns = graph.information.at[:, :3].set(0).at[:, :, :3].set(0)
    squares, _ = squared_misclosures(graph)
    assert (np.asarray(squares)[NUM - 1 :] > 100).all()
    bare = dataclasses.replace(graph, information=of_turns)
    squares, known = squared_misclosures(bare)
    assert known.all()
    assert (np.asarray(squares)[NUM - 1 :] < 30).all()
    nothing = dataclasses.replace(graph, information=jnp.zeros_like(of_turns))
    assert np.isfinite(np.asarray(squared_misclosures(nothing)[0])).all()
