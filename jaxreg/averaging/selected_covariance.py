"""Marginal covariances of chosen poses, by sparse solves in float64.

Unknowns are velocities at each pose, in the axes of the world: the normal equations are
then a graph Laplacian. Blocks of its inverse are turned into the axes of the poses.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.arrays import widened
from jaxreg._core.programs import kept_program
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.measures import deviations
from jaxreg.averaging.relaxation.connection import joined
from jaxreg.averaging.steps.gauss_newton import precisions
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.inverse_blocks import inverse_blocks
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.small import product


def selected_covariances(
    graph: PoseGraph, solution: AveragingSolution, frames: np.ndarray
) -> Float[np.ndarray, "p k k"]:
    """`(p, k, k)` in float64, with frame 0 known; NaN as `pose_covariances` has it.

    Args:
        graph: of concrete arrays.
        solution: its solution.
        frames: `(p,)` numbers of frames, each as often as wanted.
    """
    trust, noise = _noise(graph, solution)
    chosen, place = np.unique(frames, return_inverse=True)
    k = lie.tangent_dim(graph.dim)
    out = np.full((len(chosen), k, k), np.nan)
    edges = np.asarray(graph.edges)
    with jax.enable_x64(True):
        wide, T, trust, noise = widened((graph, solution.T_world_i, trust, noise))
        W = np.asarray(_informations(wide, trust, noise))
        # What is not a number holds, too: all is lost then.
        holds = np.any(W != 0, axis=(1, 2))
        held = joined(edges[holds], graph.num_poses)
        known = (held & np.asarray(solution.placed))[chosen]
        W = np.where(held[edges[:, :1, None]], W, 0)
        matrix, axes = _normal_equations(wide.edges, jnp.asarray(W), T)
        Q = np.asarray(axes)[chosen[known]]
        blocks = inverse_blocks(matrix, chosen[known])
    out[known] = Q.swapaxes(1, 2) @ blocks @ Q
    out[chosen == 0] = 0
    return out[place]


@kept_program
def _noise(graph: PoseGraph, solution: AveragingSolution) -> tuple[Array, Array]:
    """Trust in usable edges, and the deviations that they show.

    In the dtype of the graph: of motions without noise they show its rounding.
    """
    usable = jnp.all(jnp.isfinite(graph.T_i_j), axis=(1, 2)) & graph.mask
    trust = jnp.where(usable, solution.edge_weight, 0)
    return trust, deviations(graph, solution.T_world_i, trust)


@kept_program
def _informations(graph: PoseGraph, trust: Array, noise: Array) -> Array:
    """`(e, k, k)`, 0 of edges that are not trusted."""
    W = precisions(graph, trust, noise)
    W = W if graph.information is not None else W / noise[1] ** 2
    return jnp.where((graph.weight * trust > 0)[:, None, None], W, 0)


@kept_program
def _normal_equations(edges: Array, W: Array, T: Array) -> tuple[GraphLaplacian, Array]:
    """J' W J of velocities at the poses, and `(v, k, k)` their axes in the world."""
    d = T.shape[-1] - 1
    R = lie.rotation(T)
    Q = jnp.broadcast_to(jnp.eye(W.shape[-1], dtype=T.dtype), (len(T), *W.shape[1:]))
    Q = Q.at[:, :d, :d].set(R)
    Q = Q.at[:, d:, d:].set(R) if d == 3 else Q
    Q_j = Q[edges[:, 1]]
    stiffness = product(product(Q_j, W), jnp.swapaxes(Q_j, -1, -2))
    origin = lie.translation(T)
    return GraphLaplacian.anchored(edges, stiffness, len(T), 0.0, origin), Q
