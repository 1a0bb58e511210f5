"""Derivatives of averaged poses by the implicit function theorem.

At a fixed point of an averaging method some balance holds at every frame. The poses
are differentiated through that equation, not through the loop that found them.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import solve_laplacian
from jaxreg.linear.small import product


#: More of them are solved for by GMRES, which takes 200 products at most, one after the
#: other; a dense matrix takes a few for all edges, and memory by the square.
DENSE_UNKNOWNS = 400


class _Balance(eqx.Module):
    """What the poses depend on; all but the graph and `imbalance` is held."""

    graph: PoseGraph
    imbalance: Callable[[PoseGraph, Array], Array]
    fixed: Float[Array, "v D D"]
    free: Bool[Array, "v 1"]
    weight: Float[Array, " e"]
    jacobian: Callable[[PoseGraph, Array], Array]
    precondition: Callable[[Array], Array] | None

    def residual(
        self, x: Float[Array, "v k"], T_world_i: Float[Array, "v D D"]
    ) -> Float[Array, "v k"]:
        """The imbalance at left tangents; of frames that are held, the tangent."""
        balance = self.imbalance(self.graph, product(lie.exp(x), T_world_i))
        return jnp.where(self.free, balance, x)

    def matrix(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, "n n"] | None:
        """The derivative of the residual by all tangents; None of a large graph."""
        num = len(T_world_i) * lie.tangent_dim(self.graph.dim)
        if num > DENSE_UNKNOWNS:
            return None
        free = jnp.repeat(self.free[:, 0], num // len(T_world_i))
        J = self.jacobian(self.graph, T_world_i)
        return jnp.where(free[:, None], J, jnp.eye(num, dtype=J.dtype))

    def solve(self, linear: Callable[[Array], Array], y: Array) -> Array:
        """X of linear(x) = y, the derivative of the residual or its transpose."""
        if self.precondition is not None:
            return _krylov(linear, y, self.precondition)
        return _krylov(linear, y, lambda r: solve_laplacian(*self._flow, -r))

    @property
    def _flow(self) -> tuple[Array, Array]:
        return self.graph.edges, self.weight


def differentiable(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    imbalance: Callable[[PoseGraph, Array], Array],
    weight: Float[Array, " e"],
    jacobian: Callable[[PoseGraph, Array], Array],
    precondition: Callable[[Array], Array] | None = None,
) -> Float[Array, "v D D"]:
    """The same poses, with derivatives with respect to the values of the graph.

    Nothing is traced for them until they are asked for, so the two functions are
    pytrees (`eqx.Partial`) of the arrays that they use.

    Args:
        graph: the graph with the values to differentiate.
        T_world_i: a fixed point, frame 0 at the identity.
        imbalance: `(v, k)` at given poses, 0 at the fixed point; its derivative with
            respect to left tangents of the poses is near to minus the Laplacian. It may
            hold values to differentiate, too.
        weight: `(e,)` Laplacian weights of at most 1; frames without any are held.
        jacobian: the derivative of the imbalance by left tangents, `(v k, v k)`, at
            given poses; asked of small graphs alone.
        precondition: maps `(v, k)` by about the inverse of that derivative, for graphs
            that are too large for a dense matrix; by default the inverse Laplacian.
    """
    fixed, weight = jax.lax.stop_gradient((T_world_i, weight))
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    touched = jnp.zeros(fixed.shape[:1], weight.dtype).at[i].add(weight)
    free = (touched.at[j].add(weight) > 0).at[0].set(False)[:, None]
    parts = imbalance, fixed, free, weight, jacobian, precondition
    return _balanced(_Balance(graph, *parts))


@eqx.filter_custom_jvp
def _balanced(at: _Balance) -> Float[Array, "v D D"]:
    """The poses at which forces balance: those given, with derivatives."""
    return at.fixed


@_balanced.def_jvp
def _balanced_jvp(primals: tuple[_Balance], tangents: tuple) -> tuple[Array, Array]:
    (at,), T = primals, _balanced(*primals)
    still = jnp.zeros((len(T), lie.tangent_dim(at.graph.dim)), T.dtype)
    along = eqx.filter_jvp(lambda at: at.residual(still, T), primals, tangents)[1]
    if along is None:  # nothing that is differentiated has an influence
        return T, jnp.zeros_like(T)
    linear = jax.linearize(lambda x: at.residual(x, T), still)[1]
    J = at.matrix(T)
    if J is None:
        x = -jax.lax.custom_linear_solve(linear, along, at.solve, at.solve)
    else:
        there, back = partial(_solve, J), partial(_solve, J.T)
        x = -jax.lax.custom_linear_solve(linear, along, there, back)
    return T, jax.jvp(lambda x: product(lie.exp(x), T), (still,), (x,))[1]


def _solve(J: Float[Array, "n n"], _: Callable[[Array], Array], y: Array) -> Array:
    return jnp.linalg.solve(J, y.reshape(-1)).reshape(y.shape)


def _krylov(
    linear: Callable[[Array], Array], y: Array, precondition: Callable[[Array], Array]
) -> Array:
    tolerance = 100 * float(jnp.finfo(y.dtype).eps)
    return jax.scipy.sparse.linalg.gmres(
        linear,
        y,
        tol=tolerance,
        restart=20,
        maxiter=10,
        M=lambda r: precondition(r).at[0].set(r[0]),
    )[0]
