"""Covariances of chosen poses against those of all, and against a sparse inverse."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from jaxreg.averaging import (
    SpanningTree,
    average,
    pose_covariances,
)
from jaxreg.averaging.steps.gauss_newton import normal_equations
from jaxreg.graph import PoseGraph
from jaxreg.linear import inverse_blocks as module
from jaxreg.linear.operator import GraphLaplacian
from tests.averaging.graphs import random_graph


N, H = 12, 30
ANY = [5, 0, N - 1, 5]


def measured(
    d: int, *, informed: bool = True, dtype: type = np.float64
) -> tuple[PoseGraph, np.ndarray]:
    """A graph in which frames are 40 from each other, and its poses."""
    X, edges, T, _ = random_graph(N, H, 0.0, 3, d=d)
    X[:, :d, d] *= 40
    T[:, :d, d] *= 40
    k = 3 if d == 2 else 6
    root = np.random.default_rng(d).normal(size=(H, k, k))
    information = 30 * (np.eye(k) + root @ root.swapaxes(1, 2)).astype(dtype)
    told = information if informed else None
    return PoseGraph.from_edges(edges, T.astype(dtype), N, None, told), X


def agree(found: Any, wanted: Any, rtol: float = 1e-4) -> None:
    """Within a share of the deviations."""
    found, wanted = np.asarray(found, float), np.asarray(wanted, float)
    size = np.sqrt(np.einsum("paa->pa", wanted))
    size = np.where(size > 0, size, 1)
    np.testing.assert_allclose(
        found / size[:, :, None] / size[:, None],
        wanted / size[:, :, None] / size[:, None],
        atol=rtol,
        rtol=0,
    )


@pytest.mark.parametrize("informed", [True, False])
@pytest.mark.parametrize("d", [2, 3])
def test_chosen_blocks_are_those_of_all(d: int, informed: bool):
    with jax.enable_x64(True):
        graph, X = measured(d, informed=informed)
        sol = average(graph, SpanningTree(), init=X)
        every = np.asarray(pose_covariances(graph, sol))
        chosen = pose_covariances(graph, sol, poses=ANY, max_unknowns=1)
        assert isinstance(chosen, jax.Array)
        np.testing.assert_array_equal(chosen[1], 0)
        agree(chosen, every[ANY], 1e-9)
    graph, X = measured(d, informed=informed, dtype=np.float32)
    sol = average(graph, SpanningTree(), init=X)
    chosen = pose_covariances(graph, sol, poses=np.array(ANY, np.uint8))
    assert chosen.dtype == np.float32
    agree(chosen, np.asarray(pose_covariances(graph, sol))[ANY], 1e-3)


def test_frames_that_trust_does_not_join_to_the_first_are_not_known():
    graph, X = measured(2, dtype=np.float32)
    sol = average(graph, SpanningTree(), init=X)
    edges = np.asarray(graph.edges)
    few, rest = (edges < 4).all(axis=1), (edges >= 4).all(axis=1)
    cut = jnp.asarray(np.where(few | rest, np.asarray(sol.edge_weight), 0))
    cut = eqx.tree_at(lambda s: s.edge_weight, sol, cut)
    found = np.asarray(pose_covariances(graph, cut, poses=[5, 1, 0]))
    assert np.isnan(found[0]).all()
    assert np.all(np.linalg.eigvalsh(found[1]) > 0)
    np.testing.assert_array_equal(found[2], 0)


def test_what_has_no_inverse_is_not_a_number():
    graph, X = measured(2, dtype=np.float32)
    sol = average(graph, SpanningTree(), init=X)
    free = np.array(graph.information)
    at_last = (np.asarray(graph.edges) == N - 1).any(axis=1)
    free[at_last, 1:] = free[at_last, :, 1:] = 0
    for information in (free, np.full_like(free, np.nan)):
        told = jnp.asarray(information)
        loose = eqx.tree_at(lambda g: g.information, graph, told)
        found = np.asarray(pose_covariances(loose, sol, poses=[N - 1, 0]))
        assert np.isnan(found[0]).all()
        np.testing.assert_array_equal(found[1], 0)


@pytest.fixture(scope="module")
def tube() -> tuple[PoseGraph, Any, np.ndarray, np.ndarray]:
    """A graph around a tube in which right tangents are solved for, some, by SciPy."""
    num, ring = 600, 12
    step = np.arange(num)
    turn, rise = 2 * np.pi * step / ring, step / 40
    X = np.tile(np.eye(4), (num, 1, 1))
    X[:, 0, :2] = np.stack([np.cos(turn), -np.sin(turn)], 1)
    X[:, 1, :2] = np.stack([np.sin(turn), np.cos(turn)], 1)
    X[:, :3, 3] = np.stack([3 * np.cos(turn), 3 * np.sin(turn), 30 * rise], 1)
    X = np.linalg.inv(X[0]) @ X
    edges = np.concatenate(
        [np.stack([step[:-k], step[k:]], 1) for k in (1, ring, ring + 1)]
    )
    root = np.random.default_rng(0).normal(size=(len(edges), 6, 6))
    information = np.eye(6) + root @ root.swapaxes(1, 2)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    poses = np.array([num - 1, 7, 300])
    with jax.enable_x64(True):
        graph = PoseGraph.from_edges(edges, T, num, None, information)
        sol = average(graph, SpanningTree(), init=X)
        H = jax.jit(normal_equations)(graph, sol.T_world_i, information)[0]
    rows = (6 * poses[:, None] + np.arange(6)).ravel()
    columns = sla.splu(sp.csc_matrix(np.asarray(H))).solve(np.eye(6 * num)[:, rows])
    blocks = columns.reshape(num, 6, 3, 6)[poses, :, np.arange(3)]
    return graph, sol, poses, blocks


@pytest.mark.parametrize("most_fill", [10**8, 0])
def test_a_factor_and_multigrid_agree_with_a_sparse_inverse(
    tube, most_fill: int, monkeypatch: pytest.MonkeyPatch
):
    graph, sol, poses, wanted = tube
    monkeypatch.setattr(module, "_MOST_FILL", most_fill)
    with jax.enable_x64(True):
        found = pose_covariances(graph, sol, poses=poses)
    agree(found, wanted)


@pytest.mark.parametrize(("max_steps", "lacking"), [(2, np.inf), (100, 1e-30)])
def test_gradients_that_do_not_converge_are_not_believed(
    tube, max_steps: int, lacking: float, monkeypatch: pytest.MonkeyPatch
):
    graph, sol, poses, _ = tube
    monkeypatch.setattr(module, "_MOST_FILL", 0)
    monkeypatch.setattr(module, "_MAX_STEPS", max_steps)
    monkeypatch.setattr(module, "_LACKING", lacking)
    with jax.enable_x64(True):
        found = np.asarray(pose_covariances(graph, sol, poses=[0, poses[0]]))
    np.testing.assert_array_equal(found[0], 0)
    assert np.isnan(found[1]).all()


def test_matrices_that_are_not_definite_have_no_blocks():
    with jax.enable_x64(True):
        edges, eye = jnp.asarray([[0, 1], [1, 2]], jnp.int32), np.eye(3)
        weight = jnp.asarray(np.stack([eye, -eye]))
        matrix = GraphLaplacian.anchored(edges, weight, 3, 0.0, jnp.zeros((3, 2)))
        assert np.isnan(module.inverse_blocks(matrix, np.array([1, 2]))).all()


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ([], "poses: wanted frames' numbers in a sequence, at least one, found shape"),
        ([[1, 2]], "at least one, found shape (1, 2)"),
        (3, "at least one, found shape ()"),
        ([1.0], "poses: wanted frames' numbers, found dtype float64"),
        ([True], "found dtype bool"),
        ([3, N], f"from 0 to {N - 1}, found {N}"),
        ([-1], f"from 0 to {N - 1}, found -1"),
    ],
)
def test_wrong_poses_are_named(poses: Any, message: str):
    graph, X = measured(2, dtype=np.float32)
    sol = average(graph, SpanningTree(), init=X)
    with pytest.raises((TypeError, ValueError), match=re.escape(message)):
        pose_covariances(graph, sol, poses=poses)


def test_chosen_poses_are_solved_for_on_the_host():
    graph, X = measured(2, dtype=np.float32)
    sol = average(graph, SpanningTree(), init=X)
    with pytest.raises(TypeError, match="poses: solves run on the host"):
        jax.eval_shape(lambda g: pose_covariances(g, sol, poses=[1]), graph)
