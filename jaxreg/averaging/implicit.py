"""Derivatives of averaged poses by the implicit function theorem.

At a fixed point of motion averaging nothing flows into any frame: for every i,
sum over its edges of w_e log(T_world_i T_i_j inv(T_world_j)), signed, is zero. The
poses are differentiated through that equation, not through the loop.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.laplacian import divergence, solve_laplacian
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


_DENSE_UNKNOWNS = 400


def differentiable(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    weight_of: Callable[[PoseGraph, Array], Array],
) -> Float[Array, "v D D"]:
    """The same poses, with derivatives with respect to the motions and weights.

    Args:
        graph: the graph with the values to differentiate.
        T_world_i: a fixed point, frame 0 at the identity.
        weight_of: the Laplacian weights of the edges at given poses.
    """
    T_fixed = jax.lax.stop_gradient(T_world_i)
    num, k = T_fixed.shape[0], lie.tangent_dim(graph.dim)
    held = jax.lax.stop_gradient(weight_of(graph, T_fixed))
    top = jnp.max(held)
    top = jnp.where(top > 0, top, 1)
    touched = jnp.zeros((num,), held.dtype)
    touched = touched.at[graph.edges[:, 0]].add(held).at[graph.edges[:, 1]].add(held)
    free = (touched > 0).at[0].set(False)[:, None]

    def imbalance(x: Array) -> Array:
        tangent = x.reshape(num, k)
        T = lie.exp(tangent) @ T_fixed
        flow = (weight_of(graph, T) / top)[:, None] * lie.log(graph.residual_motions(T))
        balance = divergence(graph.edges, flow, num)
        return jnp.where(free, balance, tangent).reshape(-1)

    solver = (
        _dense if num * k <= _DENSE_UNKNOWNS else _krylov(graph.edges, held / top, k)
    )

    def tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
        return jax.lax.custom_linear_solve(linear, y, solver, solver)

    x = jax.lax.custom_root(
        imbalance,
        jnp.zeros((num * k,), T_fixed.dtype),
        lambda _, x: x,
        tangent_solve,
    )
    return lie.exp(x.reshape(num, k)) @ T_fixed


_Solver = Callable[[Callable[[Array], Array], Array], Array]


def _dense(linear: Callable[[Array], Array], y: Array) -> Array:
    columns = jax.vmap(linear)(jnp.eye(y.shape[0], dtype=y.dtype))
    return jnp.linalg.solve(columns.T, y)


def _krylov(edges: Array, weight: Array, k: int) -> _Solver:
    """GMRES; around a consistent graph the Jacobian is minus the Laplacian."""

    def solve(linear: Callable[[Array], Array], y: Array) -> Array:
        def precondition(r: Array) -> Array:
            rows = r.reshape(-1, k)
            return solve_laplacian(edges, weight, -rows).at[0].set(rows[0]).reshape(-1)

        tolerance = 100 * float(jnp.finfo(y.dtype).eps)
        return jax.scipy.sparse.linalg.gmres(
            linear, y, tol=tolerance, restart=20, maxiter=10, M=precondition
        )[0]

    return solve
