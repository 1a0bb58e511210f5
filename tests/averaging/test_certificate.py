"""The certificate beside a dense oracle, and the staircase out of wrong minima."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg._core.status import Status
from jaxreg.averaging import (
    MCC,
    AveragingSolution,
    ChordalError,
    PoseGraphLM,
    SpanningTree,
    average,
)
from jaxreg.averaging.certificate import certify
from jaxreg.averaging.methods.riemannian_staircase import RiemannianStaircase
from jaxreg.averaging.relaxation.certificate_matrix import CertificateMatrix
from jaxreg.averaging.relaxation.connection import Connection, lifted
from jaxreg.averaging.relaxation.staircase import climb
from jaxreg.graph import PoseGraph
from jaxreg.graph.chordal import chordal_weights
from jaxreg.io import read_g2o
from jaxreg.metrics import chordal_objective
from tests.averaging.graphs import motions, random_graph, rotations
from tests.helpers import data_dir


N, H = 6, 12


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def noisy(d: int, seed: int = 0) -> PoseGraph:
    """A graph with noise of some degrees, weights and information."""
    _, edges, T, _ = random_graph(N, H, 0.0, seed, d=d, noise=10.0)
    rng = np.random.default_rng(seed)
    k = 6 if d == 3 else 3
    half = rng.normal(size=(H, k, k))
    information = np.eye(k) + half @ half.swapaxes(1, 2)
    return PoseGraph.from_edges(edges, T, N, rng.uniform(0.5, 2, H), information)


def ring(num: int, d: int, noise: float = 0.0) -> tuple[PoseGraph, np.ndarray]:
    """Steps of length one around a circle, and poses that turn once too often.

    They are a local minimum of the objective.
    """
    rng = np.random.default_rng(0)

    def turn(angle: np.ndarray) -> np.ndarray:
        axis = angle[:, None] * [0, 0, 1]
        return Rotation.from_rotvec(axis).as_matrix()[:, :d, :d]

    i = np.arange(num)
    angle = 2 * np.pi * i / num
    place = np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)[:, :d]
    place *= num / (2 * np.pi)
    X = motions(turn(angle), place)
    edges = np.stack([i, (i + 1) % num], axis=1)
    error = motions(rotations(rng, num, d, noise), noise * rng.normal(size=(num, d)))
    T = np.linalg.inv(X) @ X[edges[:, 1]] @ error
    return PoseGraph.from_edges(edges, T, num), motions(turn(2 * angle), 0 * place)


def solved(graph: PoseGraph, T: np.ndarray) -> AveragingSolution:
    """Any poses as a solution."""
    sol = average(graph, SpanningTree())
    return dataclasses.replace(sol, T_world_i=jnp.asarray(T, sol.T_world_i.dtype))


def connection(graph: PoseGraph) -> Connection:
    weights = chordal_weights(graph)
    kappa, tau = (np.asarray(w) for w in weights)
    edges, T = np.asarray(graph.edges), np.asarray(graph.T_i_j)
    return Connection.of(edges, T, (kappa, tau), graph.num_poses)


def dense_least(graph: PoseGraph, T: np.ndarray) -> tuple[float, float]:
    """The least eigenvalue over rotations and the trace of the multipliers, densely."""
    d, D, num = graph.dim, graph.dim + 1, graph.num_poses
    kappa, tau = (np.asarray(w) for w in chordal_weights(graph))
    M = np.zeros((num * D, num * D))
    for (i, j), motion, k, t in zip(
        np.asarray(graph.edges), np.asarray(graph.T_i_j), kappa, tau, strict=True
    ):
        B = np.zeros((D, num * D))
        B[:, j * D : j * D + D] = np.eye(D)
        B[:, i * D : i * D + D] = -motion.T
        M += B.T @ np.diag([k] * d + [t]) @ B
    X = np.concatenate([pose[:-1] for pose in np.asarray(T)], axis=1)
    pulls, S, trace = X @ M, M.copy(), 0.0
    for v in range(num):
        at = slice(v * D, v * D + d)
        block = pulls[:, at].T @ X[:, at]
        block = (block + block.T) / 2
        S[at, at] -= block
        trace += np.trace(block)
    shift = np.arange(num * D) % D == d
    over = S[np.ix_(~shift, shift)]
    reduced = S[np.ix_(~shift, ~shift)]
    reduced -= over @ np.linalg.pinv(S[np.ix_(shift, shift)]) @ over.T
    return np.linalg.eigvalsh(reduced)[0], trace


@pytest.mark.parametrize("d", [2, 3])
def test_the_least_eigenvalue_is_that_of_the_dense_matrix(d: int):
    graph = noisy(d)
    rng = np.random.default_rng(1)
    best = np.asarray(average(graph, RiemannianStaircase()).T_world_i)
    wild = motions(rotations(rng, N, d, None), rng.normal(size=(N, d)))
    for T in (best, wild):
        matrix = CertificateMatrix.of(connection(graph), lifted(T))
        value, trace = dense_least(graph, T)
        found = matrix.least(0.0)
        scale = max(abs(value), 1.0)
        assert found.value == pytest.approx(value, abs=1e-6 * scale)
        assert -found.above <= value + 1e-12 * scale
        assert matrix.trace == pytest.approx(trace)
        # A direction in which the objective curves as said.
        S = connection(graph).with_multipliers(connection(graph).multipliers(lifted(T)))
        x = found.vector.ravel()
        assert x @ (S @ x) / np.sum(found.vector[:, :d] ** 2) == pytest.approx(
            value, abs=1e-4 * scale
        )


@pytest.mark.parametrize("d", [2, 3])
def test_no_poses_are_below_the_bound(d: int):
    graph = noisy(d)
    optimum = float(
        chordal_objective(graph, average(graph, RiemannianStaircase()).T_world_i)
    )
    rng = np.random.default_rng(2)
    for _ in range(4):
        wild = motions(rotations(rng, N, d, None), rng.normal(size=(N, d)))
        found = certify(graph, solved(graph, wild))
        assert not found.certified
        assert found.status == Status.UNCERTIFIED
        assert 0 <= found.lower_bound <= optimum * (1 + 1e-12)
        assert found.objective == pytest.approx(float(chordal_objective(graph, wild)))
        assert found.gap == found.objective - found.lower_bound


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_twisted_ring_is_not_certified_and_the_staircase_untwists_it(
    d: int, noise: float
):
    graph, twisted = ring(16, d, noise)
    wrong = average(graph, PoseGraphLM(ChordalError()), init=twisted)
    found = certify(graph, wrong)
    assert found.objective > 1  # a minimum, and a wrong one
    assert found.minimum == pytest.approx(found.objective, rel=1e-3)
    assert not found.certified
    assert found.least_eigenvalue < -1e-3
    ended = climb(connection(graph), np.asarray(wrong.T_world_i), 1e-7, 10)
    assert ended.optimal
    assert ended.rank > d
    right = certify(graph, solved(graph, ended.T_world_i))
    assert right.certified
    assert right.status == Status.CONVERGED
    best = average(graph, RiemannianStaircase(), init=twisted)
    assert best.status == Status.CONVERGED
    assert float(chordal_objective(graph, best.T_world_i)) == pytest.approx(
        right.objective, abs=1e-9
    )


def test_the_bound_follows_units_and_frames():
    graph = noisy(3)
    sol = average(graph, RiemannianStaircase())
    found = certify(graph, sol)
    assert found.certified
    moved = solved(graph, np.asarray(sol.T_world_i[3] @ sol.T_world_i))
    other = certify(graph, moved)
    assert other.certified
    assert other.objective == pytest.approx(found.objective)
    assert other.lower_bound == pytest.approx(found.lower_bound, rel=1e-6)


def test_float32_poses_are_certified_up_to_their_rounding():
    graph = noisy(3)
    with jax.enable_x64(False):
        narrow = PoseGraph.from_edges(
            np.asarray(graph.edges),
            np.asarray(graph.T_i_j, np.float32),
            N,
            np.asarray(graph.weight, np.float32),
            np.asarray(graph.information, np.float32),
        )
        sol = average(narrow, RiemannianStaircase())
        assert sol.T_world_i.dtype == jnp.float32
        assert sol.status == Status.CONVERGED
        found = certify(narrow, sol)
    assert found.certified
    assert found.eigenvector.dtype == np.float64


def test_robust_poses_are_judged_by_the_edges_that_they_trust():
    X, edges, T, bad = random_graph(12, 40, 0.2, 3)
    graph = PoseGraph.from_edges(edges, T, 12)
    sol = average(graph, MCC(), init=X)
    found = certify(graph, sol)
    assert found.num_edges == np.sum(np.asarray(sol.edge_weight) > 0.5)
    assert found.num_edges <= np.sum(~bad)
    right = np.asarray(sol.edge_weight) > 0.5
    clean = PoseGraph.from_edges(edges[right], T[right], 12)
    best = float(
        chordal_objective(clean, average(clean, RiemannianStaircase()).T_world_i)
    )
    assert found.lower_bound == pytest.approx(best, rel=1e-5)
    # Another objective: near the best, and the gap says how near.
    assert 0 <= found.gap < 0.5 * found.objective


def test_small_and_broken_graphs():
    one = np.eye(4)
    one[0, 3] = 2.0
    pair = PoseGraph.from_edges([(0, 1)], [one])
    found = certify(pair, average(pair, PoseGraphLM(ChordalError())))
    assert found.certified
    assert found.objective == pytest.approx(0, abs=1e-20)

    apart = PoseGraph.from_edges([(0, 1), (2, 3)], [one, one])
    found = certify(apart, average(apart, PoseGraphLM(ChordalError())))
    assert found.status == Status.DISCONNECTED
    assert found.covered.tolist() == [True, True, False, False]

    none = PoseGraph.from_edges([(0, 1), (1, 2)], [one, one], weight=[0.0, 0.0])
    found = certify(none, average(none, PoseGraphLM(ChordalError())))
    assert found.status == Status.DISCONNECTED
    assert found.num_edges == 0
    assert average(none, RiemannianStaircase()).status == Status.DISCONNECTED

    sol = average(pair, PoseGraphLM(ChordalError()))
    broken = dataclasses.replace(sol, T_world_i=sol.T_world_i.at[1, 0, 3].set(jnp.nan))
    found = certify(pair, broken)
    assert found.status == Status.NON_FINITE
    assert not found.certified

    one[0, 3] = 1e200  # whose square is not finite
    endless = PoseGraph.from_edges([(0, 1), (1, 2)], [one, one])
    found = certify(endless, average(endless, PoseGraphLM(ChordalError())))
    assert found.status == Status.NON_FINITE


def test_wrong_arguments_are_named():
    graph = noisy(2)
    sol = average(graph, SpanningTree())
    with pytest.raises(TypeError, match="solution"):
        certify(graph, sol.T_world_i)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="min_trust"):
        certify(graph, sol, min_trust=1.5)
    with pytest.raises(ValueError, match="solution"):
        certify(noisy(3), sol)
    with pytest.raises(TypeError, match="not inside jit"):
        jax.jit(lambda g: certify(g, sol).lower_bound)(graph)


def test_a_rank_that_ends_too_early_is_told():
    graph, twisted = ring(16, 3)
    ended = climb(connection(graph), twisted, 1e-7, 3)
    assert not ended.optimal
    assert "RiemannianStaircase" in Status.UNCERTIFIED.advice


def test_a_certificate_reads_and_pickles():
    graph = noisy(2)
    found = certify(graph, average(graph, RiemannianStaircase()))
    assert repr(found).startswith("Certificate(certified: objective ")
    again = pickle.loads(pickle.dumps(found))
    assert again.lower_bound == found.lower_bound


@pytest.mark.parametrize(
    ("name", "optimum"), [("smallGrid3D", 1025.398), ("MIT", 61.1541)]
)
def test_public_graphs_from_random_poses(name: str, optimum: float):
    graph = read_g2o(data_dir() / "pose_graphs" / f"{name}.g2o")
    rng = np.random.default_rng(0)
    num, d = graph.num_poses, graph.dim
    wild = motions(rotations(rng, num, d, None), 10 * rng.normal(size=(num, d)))
    ended = climb(connection(graph), wild, 2.5e-7, 10)
    assert ended.optimal
    found = certify(graph, solved(graph, ended.T_world_i))
    assert found.certified
    assert found.objective == pytest.approx(optimum, rel=1e-6)
