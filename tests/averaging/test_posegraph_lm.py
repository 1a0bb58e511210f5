import dataclasses

import chex
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxreg._core.status import Status
from jaxreg.averaging import ChordalError, LogError, PoseGraphLM, average
from jaxreg.graph import PoseGraph
from jaxreg.io import read_g2o
from jaxreg.metrics import chordal_objective
from jaxreg.robust import GemanMcClure
from tests.averaging.graphs import motions, random_graph
from tests.helpers import data_dir


N, H = 6, 12


def problem(d: int, outliers: float = 0.0):
    X, edges, T, bad = random_graph(N, H, outliers, 1, d=d, noise=10.0)
    rng = np.random.default_rng(0)
    k = 6 if d == 3 else 3
    half = rng.normal(size=(H, k, k))
    weight = rng.uniform(0.5, 2, H)
    information = np.eye(k) + half @ half.swapaxes(1, 2)
    return X, edges, T, weight, information, bad


def poses(x: np.ndarray, d: int, start: np.ndarray) -> np.ndarray:
    """Starting poses turned and shifted by parameters, pose 0 held."""
    x = np.concatenate([np.zeros((1, x.size // (N - 1))), x.reshape(N - 1, -1)])
    if d == 3:
        R = Rotation.from_rotvec(x[:, 3:]).as_matrix()
    else:
        turn = np.concatenate([np.zeros((N, 2)), x[:, 2:]], axis=1)
        R = Rotation.from_rotvec(turn).as_matrix()[:, :2, :2]
    return start @ motions(R, x[:, :d])


def log_errors(graph: tuple, T: np.ndarray) -> np.ndarray:
    """log(inv(T_i_j) inv(T_i) T_j) by closed forms, whitened."""
    _, edges, motion, weight, information, _ = graph
    gap = np.linalg.inv(motion) @ np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    d = gap.shape[-1] - 1
    out = []
    for G, w, info in zip(gap, weight, information, strict=True):
        if d == 3:
            v = Rotation.from_matrix(G[:3, :3]).as_rotvec()
            W = np.cross(np.eye(3), v)
            a = np.linalg.norm(v)
            c = (1 - a * np.sin(a) / (2 * (1 - np.cos(a)))) / a**2
            V = np.eye(3) - W / 2 + c * W @ W
        else:
            v = np.array([np.arctan2(G[1, 0], G[0, 0])])
            half = v[0] / 2
            V = half / np.tan(half) * np.eye(2) + half * np.array([[0, 1], [-1, 0]])
        r = np.concatenate([V @ G[:d, d], v])
        out.append(np.linalg.cholesky(w * info).T @ r)
    return np.array(out)


def chordal_errors(graph: tuple, T: np.ndarray) -> np.ndarray:
    _, edges, motion, weight, information, _ = graph
    d = T.shape[-1] - 1
    gap = T[edges[:, 1]] - T[edges[:, 0]] @ motion
    tau = d / np.trace(np.linalg.inv(information[:, :d, :d]), axis1=1, axis2=2)
    if d == 3:
        rotation = np.linalg.inv(information[:, 3:, 3:])
        kappa = 1.5 / np.trace(rotation, axis1=1, axis2=2)
    else:
        kappa = information[:, 2, 2]
    R = gap[:, :d, :d].reshape(H, -1) * np.sqrt(weight * kappa)[:, None]
    t = gap[:, :d, d] * np.sqrt(weight * tau)[:, None]
    return np.concatenate([R, t], axis=1)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("error", [LogError(), ChordalError()])
def test_minimum_against_scipy(error, d):
    graph = problem(d)
    X, edges, T, weight, information, _ = graph
    chordal = isinstance(error, ChordalError)
    errors = chordal_errors if chordal else log_errors
    best = least_squares(
        lambda x: errors(graph, poses(x, d, X)).ravel(),
        np.zeros((N - 1) * information.shape[-1]),
        xtol=1e-12,
        ftol=1e-12,
    )
    with jax.enable_x64(True):
        posed = PoseGraph.from_edges(edges, T, N, weight, information)
        method = PoseGraphLM(error, tolerance=1e-12)
        solution = average(posed, method, init=X)
        assert solution.status == Status.CONVERGED
        np.testing.assert_allclose(solution.T_world_i, poses(best.x, d, X), atol=1e-5)
        if chordal:
            value = chordal_objective(posed, solution.T_world_i)
            np.testing.assert_allclose(value, 2 * best.cost, rtol=1e-8)


def test_a_kernel_ends_at_its_own_minimum_and_names_wrong_edges():
    graph = problem(3, outliers=0.2)
    X, edges, T, weight, information, bad = graph
    with jax.enable_x64(True):
        posed = PoseGraph.from_edges(edges, T, N, weight, information)
        method = PoseGraphLM(kernel=GemanMcClure(), tolerance=1e-13, max_steps=200)
        solution = average(posed, method, init=X)
        found = np.asarray(solution.T_world_i)

    def cost(x: np.ndarray) -> float:
        s = (log_errors(graph, poses(x, 3, found)) ** 2).sum(axis=1)
        return (s / (1 + s / 9.0)).sum()

    steps = 1e-4 * np.eye(6 * (N - 1))
    slope = np.array([cost(h) - cost(-h) for h in steps]) / 2e-4
    bend = np.array([cost(h) + cost(-h) - 2 * cost(0 * h) for h in steps]) / 1e-8
    assert (bend > 0).all()
    np.testing.assert_allclose(slope / bend, 0, atol=1e-5)
    trust = np.asarray(solution.edge_weight)
    assert trust[bad].max() < trust[~bad].min()


def test_single_precision_from_the_motions_alone():
    X, edges, T, *_ = random_graph(N, H, 0.0, 1, noise=0.0)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), N)
    solution = average(graph, PoseGraphLM())
    assert solution.status == Status.CONVERGED
    assert solution.T_world_i.dtype == jnp.float32
    np.testing.assert_allclose(solution.T_world_i, X, atol=1e-4)
    num, trace = int(solution.num_steps), solution.trace
    assert trace is not None
    assert int(trace.num_rows) == num
    assert trace.change[num - 1] < 1e-4
    assert np.isinf(trace.kernel_width[:num]).all()


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "optimum"), [("smallGrid3D", 1025.398), ("MIT", 61.1541)]
)
def test_certified_optima_from_the_motions_alone(name, optimum):
    with jax.enable_x64(True):
        graph = read_g2o(data_dir("pose_graphs", f"{name}.g2o"))
        solution = average(graph, PoseGraphLM(ChordalError()))
        assert solution.status == Status.CONVERGED
        value = chordal_objective(graph, solution.T_world_i)
    np.testing.assert_allclose(value, optimum, rtol=1e-5)


@pytest.mark.parametrize(
    "solver",
    [optimistix.LevenbergMarquardt(1e-10, 1e-10), optimistix.BFGS(1e-10, 1e-10)],
    ids=lambda s: type(s).__name__,
)
def test_solvers_of_optimistix_end_at_the_same_minimum(solver):
    X, edges, T, weight, information, _ = problem(3, outliers=0.2)
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, N, weight, information)
        ours = PoseGraphLM(kernel=GemanMcClure(), tolerance=1e-13, max_steps=200)
        theirs = dataclasses.replace(ours, solver=solver, tolerance=1e-9)
        found = average(graph, theirs, init=X)
        expected = average(graph, ours, init=X)
        assert found.status == Status.CONVERGED
        assert np.abs(expected.T_world_i - X).max() > 1e-2
        chex.assert_trees_all_close(found.T_world_i, expected.T_world_i, atol=1e-6)
        chex.assert_trees_all_close(found.edge_weight, expected.edge_weight, atol=1e-6)


@pytest.mark.parametrize("linear", [lineax.Cholesky(), lineax.CG(1e-10, 1e-10)])
def test_solvers_of_lineax_take_the_same_steps(linear):
    X, edges, T, weight, information, _ = problem(2)
    weight[edges[:, 1] == N - 1] = weight[edges[:, 0] == N - 1] = 0  # one pose is free
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, N, weight, information)
        ours = PoseGraphLM(tolerance=1e-12)
        found = average(graph, dataclasses.replace(ours, linear_solver=linear), init=X)
        expected = average(graph, ours, init=X)
        assert found.status == expected.status == Status.DISCONNECTED
        assert found.num_steps <= expected.num_steps
        chex.assert_trees_all_close(found.T_world_i, expected.T_world_i, atol=1e-7)


def test_what_is_no_solver_is_refused():
    with pytest.raises(TypeError, match="PoseGraphLM: solver: wanted a minimiser"):
        PoseGraphLM(solver=lineax.Cholesky())
    with pytest.raises(TypeError, match="linear_solver: wanted a solver of lineax"):
        PoseGraphLM(linear_solver=optimistix.BFGS(1e-6, 1e-6))
    with pytest.raises(ValueError, match="one of their own"):
        PoseGraphLM(solver=optimistix.BFGS(1e-6, 1e-6), linear_solver=lineax.Cholesky())


def test_one_step_straightens_a_long_path_that_drifted():
    # Turns of 1e-3 at random: a start 2,500 edges long that bends by a twentieth. On
    # the arcs of exp(x) its far end leaves the step by more than the noise.
    num = 2500
    turn = 1e-3 * np.random.default_rng(0).normal(size=num - 1)
    angle = np.cumsum(np.append(0, turn))
    c, s = np.cos(angle), np.sin(angle)
    place = np.cumsum(np.stack([c, s], axis=1), axis=0)
    bent = motions(np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0), place)
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    ahead = np.tile(np.eye(3), (num - 1, 1, 1))
    ahead[:, 0, 2] = 1
    information = np.tile(np.diag([2500.0, 2500, 1e4]), (num - 1, 1, 1))
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, ahead, num, None, information)
        start = jnp.asarray(np.linalg.inv(bent[0]) @ bent)
        T = np.asarray(average(graph, PoseGraphLM(max_steps=1), init=start).T_world_i)
    left = np.linalg.inv(ahead) @ np.linalg.inv(T[:-1]) @ T[1:]
    assert np.std(left[:, 1, 0]) < 0.1 * np.std(turn)
    assert np.abs(left[:, :2, 2]).max() < 1e-3
