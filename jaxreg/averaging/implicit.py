"""Derivatives of averaged poses by the implicit function theorem.

At a fixed point of an averaging method some balance holds at every frame. The poses
are differentiated through that equation, not through the loop that found them.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.laplacian import solve_laplacian
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, product


#: More of them are solved for by GMRES.
DENSE_UNKNOWNS = 400


def differentiable(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    imbalance: Callable[[PoseGraph, Array], Array],
    weight: Float[Array, " e"],
    precondition: Callable[[Array], Array] | None = None,
) -> Float[Array, "v D D"]:
    """The same poses, with derivatives with respect to the values of the graph.

    Args:
        graph: the graph with the values to differentiate.
        T_world_i: a fixed point, frame 0 at the identity.
        imbalance: `(v, k)` at given poses, 0 at the fixed point; its derivative with
            respect to left tangents of the poses is near to minus the Laplacian.
        weight: `(e,)` Laplacian weights of at most 1; frames without any are held.
        precondition: maps `(v, k)` by about the inverse of that derivative, for graphs
            that are too large for a dense matrix; by default the inverse Laplacian.
    """
    fixed, weight = jax.lax.stop_gradient((T_world_i, weight))
    num, k = fixed.shape[0], lie.tangent_dim(graph.dim)
    touched = jnp.zeros((num,), weight.dtype)
    touched = (
        touched.at[graph.edges[:, 0]].add(weight).at[graph.edges[:, 1]].add(weight)
    )
    free = (touched > 0).at[0].set(False)[:, None]

    def residual(x: Array) -> Array:
        tangent = x.reshape(num, k)
        balance = imbalance(graph, product(lie.exp(tangent), fixed))
        return jnp.where(free, balance, tangent).reshape(-1)

    small = num * k <= DENSE_UNKNOWNS
    if precondition is None:
        precondition = _inverse_laplacian(graph.edges, weight)
    solver = _dense if small else _krylov(precondition, k)

    def tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
        return jax.lax.custom_linear_solve(linear, y, solver, solver)

    x = jax.lax.custom_root(
        residual,
        jnp.zeros((num * k,), fixed.dtype),
        lambda _, x: x,
        tangent_solve,
    )
    return product(lie.exp(x.reshape(num, k)), fixed)


_Solver = Callable[[Callable[[Array], Array], Array], Array]


def _dense(linear: Callable[[Array], Array], y: Array) -> Array:
    columns = jax.vmap(linear)(jnp.eye(y.shape[0], dtype=y.dtype))
    return jnp.linalg.solve(columns.T, y)


def _inverse_laplacian(edges: Array, weight: Array) -> Callable[[Array], Array]:
    return lambda rows: solve_laplacian(edges, weight, -rows)


def _krylov(precondition: Callable[[Array], Array], k: int) -> _Solver:
    def solve(linear: Callable[[Array], Array], y: Array) -> Array:
        def held(r: Array) -> Array:
            rows = r.reshape(-1, k)
            return precondition(rows).at[0].set(rows[0]).reshape(-1)

        tolerance = 100 * float(jnp.finfo(y.dtype).eps)
        return jax.scipy.sparse.linalg.gmres(
            linear, y, tol=tolerance, restart=20, maxiter=10, M=held
        )[0]

    return solve
