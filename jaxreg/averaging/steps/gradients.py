"""Derivatives of where the loops of averaging end, by what balances there."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.steps.edge_jacobian import edge_jacobian
from jaxreg.averaging.steps.gauss_newton import forces, precisions
from jaxreg.averaging.steps.implicit import differentiable
from jaxreg.averaging.steps.iterate import Iterated, TrustOf, WidthOf, held_width
from jaxreg.averaging.steps.rows import AbstractRows
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.operator import divergence
from jaxreg.linear.small import product


#: What pushes each frame `(v, k)` at given poses and widths: a sum over edges, each by
#: its two poses alone.
Push = Callable[[PoseGraph, Array, Array], Array]


def averaging_gradients(
    graph: PoseGraph,
    end: Iterated,
    trust_of: TrustOf,
    rows: AbstractRows,
    width_of: WidthOf = held_width,
) -> Iterated:
    """The end of motion averaging, with derivatives by the balance of flows.

    `trust_of` and `width_of`, which give trust and widths the derivatives that they are
    to have, are pytrees of the values that they use.
    """
    weight = rows.squared(jax.lax.stop_gradient(graph), end.trust)
    weight, top = _over_the_largest(weight)
    flow = eqx.Partial(_net_flow, trust_of, rows, top)
    return _with_gradients(graph, end, flow, trust_of, width_of, weight)


def gauss_newton_gradients(
    graph: PoseGraph,
    end: Iterated,
    trust_of: TrustOf,
    width_of: WidthOf = held_width,
) -> Iterated:
    """The same of Gauss-Newton steps, by the balance of forces at the minimum."""
    weight, _ = _over_the_largest(jax.lax.stop_gradient(graph.weight * end.trust))
    force = eqx.Partial(_net_force, trust_of)
    return _with_gradients(graph, end, force, trust_of, width_of, weight)


def _with_gradients(
    graph: PoseGraph,
    end: Iterated,
    push: Push,
    trust_of: TrustOf,
    width_of: WidthOf,
    weight: Float[Array, " e"],
) -> Iterated:
    imbalance = eqx.Partial(_imbalance, push, width_of, end.width)
    jacobian = eqx.Partial(_jacobian, push, width_of, end.width)
    T = differentiable(graph, end.T_world_i, imbalance, weight, jacobian)
    width = width_of(graph, T, end.width)
    return end._replace(T_world_i=T, trust=trust_of(graph, T, width), width=width)


def _imbalance(
    push: Push, width_of: WidthOf, width: Array, graph: PoseGraph, T: Array
) -> Float[Array, "v k"]:
    return push(graph, T, width_of(graph, T, width))


def _jacobian(
    push: Push, width_of: WidthOf, width: Array, graph: PoseGraph, T: Array
) -> Float[Array, "n n"]:
    """Of the imbalance: what each edge does, and the widths, which follow all poses."""
    width = width_of(graph, T, width)
    J = edge_jacobian(lambda g, T: push(g, T, width), graph, T)
    if width_of is held_width:
        return J
    still = jnp.zeros((len(T), lie.tangent_dim(graph.dim)), T.dtype)
    by_width = jax.jacfwd(lambda w: push(graph, T, w))(width)
    follow = jax.jacrev(lambda x: width_of(graph, product(lie.exp(x), T), width))(still)
    return J + by_width.reshape(len(J), 2) @ follow.reshape(2, len(J))


def _net_force(
    trust_of: TrustOf, graph: PoseGraph, T: Array, width: Array
) -> Float[Array, "v k"]:
    return forces(graph, T, precisions(graph, trust_of(graph, T, width), width))


def _net_flow(
    trust_of: TrustOf,
    rows: AbstractRows,
    top: Array,
    graph: PoseGraph,
    T: Array,
    width: Array,
) -> Float[Array, "v k"]:
    """What flows into each frame, by weights over the largest."""
    weight = rows.squared(graph, trust_of(graph, T, width)) / top
    flow = weight[:, None] * lie.log(graph.residual_motions(T))
    return divergence(graph.edges, flow, graph.num_poses)


def _over_the_largest(weight: Float[Array, " e"]) -> tuple[Array, Array]:
    top = jnp.max(weight)
    top = jnp.where(top > 0, top, 1)
    return weight / top, top
