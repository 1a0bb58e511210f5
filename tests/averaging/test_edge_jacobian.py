"""Dense derivatives of balances, against one product for each unknown."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.averaging import RootRows
from jaxreg.averaging.methods.mcc import _width as mean_residual
from jaxreg.averaging.steps import gradients
from jaxreg.averaging.steps.edge_jacobian import edge_jacobian
from jaxreg.averaging.steps.iterate import held_width
from jaxreg.averaging.steps.kernel_width import gaussian_trust
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


def _graph(d: int) -> tuple[PoseGraph, jax.Array]:
    """Eight poses, off; an edge twice, one backwards, one of weight 0, two wrong."""
    X, edges, T, _ = random_graph(8, 18, 0.1, 3, d=d)
    edges = np.concatenate([edges, edges[:1], edges[1:2, ::-1]])
    T = np.concatenate([T, T[:1], np.linalg.inv(T[1:2])])
    weight = np.linspace(0, 1, len(edges))
    graph = PoseGraph.from_edges(edges, T, len(X), weight)
    off = np.random.default_rng(0).normal(size=(len(X), lie.tangent_dim(d)))
    return graph, jax.jit(lambda x: lie.exp(x) @ X)(0.2 * off)


@eqx.filter_jit
def _by_unknowns(imbalance, graph: PoseGraph, T: jax.Array) -> jax.Array:
    still = jnp.zeros((len(T), lie.tangent_dim(graph.dim)), T.dtype)
    J = jax.jacfwd(lambda x: imbalance(graph, lie.exp(x) @ T))(still)
    return J.reshape(still.size, still.size)


_by_edges: Any = eqx.filter_jit(edge_jacobian)
_jacobian = eqx.filter_jit(gradients._jacobian)


def _agree(J: jax.Array, expected: jax.Array) -> None:
    largest = np.abs(np.asarray(expected)).max()
    np.testing.assert_allclose(J, expected, atol=1e-11 * largest)


@pytest.mark.parametrize("d", [2, 3])
def test_where_each_edge_adds_by_itself(d):
    with jax.enable_x64(True):
        graph, T = _graph(d)
        width, lengths = jnp.asarray([0.3, 0.2]), np.array(0.7)
        for push in (
            eqx.Partial(gradients._net_force, gaussian_trust),
            eqx.Partial(gradients._net_flow, gaussian_trust, RootRows(), lengths),
        ):
            alone = eqx.Partial(gradients._imbalance, push, held_width, width)
            _agree(_by_edges(alone, graph, T), _by_unknowns(alone, graph, T))


@pytest.mark.parametrize("d", [2, 3])
def test_where_edges_share_widths_that_follow_the_poses(d):
    with jax.enable_x64(True):
        graph, T = _graph(d)
        push = eqx.Partial(gradients._net_force, gaussian_trust)
        follow = eqx.Partial(mean_residual, 1.0, np.array(1.0))
        parts = push, follow, jnp.ones(2)
        J = _jacobian(*parts, graph, T)
        expected = _by_unknowns(eqx.Partial(gradients._imbalance, *parts), graph, T)
        _agree(J, expected)
        held = push, held_width, eqx.filter_jit(follow)(graph, T, jnp.ones(2))
        moved = np.asarray(_jacobian(*held, graph, T)) - np.asarray(expected)
        assert np.abs(moved).max() > 1e-2 * np.abs(np.asarray(expected)).max()
