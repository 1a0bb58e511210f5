"""How well a graph determines the poses that were averaged from it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import check_count
from jaxreg._core.programs import kept_program
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.measures import deviations
from jaxreg.averaging.steps.gauss_newton import normal_equations, precisions
from jaxreg.averaging.world.adjusted import Told, as_adjusted
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def pose_covariances(
    graph: PoseGraph,
    solution: AveragingSolution,
    *,
    max_unknowns: int = 6000,
    priors: Told = None,
    fixed: Told = None,
    control: Told = None,
    levels: Told = None,
) -> Float[Array, "v k k"]:
    """The marginal covariance of each pose, with frame 0 known exactly.

    Of right tangents x in T_world_i exp(x), translation first, as g2o and GTSAM give
    them: the diagonal blocks of inv(J' W J) with W the information of each edge times
    prior weight and `edge_weight`. Without information the noise is taken to be what
    the edges show: one variance for translations and one for rotations, from the
    errors that the poses leave.

    Args:
        graph: the graph that was averaged.
        solution: its solution, from any method.
        max_unknowns: k per frame, at most; the matrix is dense, 144 MB of float32 for
            the default (static).
        priors: those that `average` was given; then frame 0 is held by nothing else.
        fixed: likewise.
        control: likewise.
        levels: likewise.

    Returns:
        `(v, k, k)`; 0 for frame 0, or for fixed frames; NaN for frames that no trusted
        edge holds.

    Raises:
        ValueError: for more unknowns than `max_unknowns`, and for a solution of another
            graph.
        TypeError: for anything but a graph and a solution.

    Gradients: none (cut).
    """
    whole, placed, first = as_adjusted(graph, solution, priors, fixed, control, levels)
    check_count(max_unknowns, "max_unknowns")
    k = lie.tangent_dim(graph.dim)
    if graph.num_poses * k > max_unknowns:
        raise ValueError(
            f"graph: wanted at most {max_unknowns // k} poses for covariances, "
            f"found {graph.num_poses}."
        )
    covariances = _covariances(whole, placed)[first:]
    if not fixed:
        return covariances
    frames = np.array([row[0] for row in fixed], np.int32)
    return covariances.at[jax.device_put(frames)].set(0)


@kept_program
def _covariances(
    graph: PoseGraph, solution: AveragingSolution
) -> Float[Array, "v k k"]:
    graph, solution = jax.lax.stop_gradient((graph, solution))
    num, k = graph.num_poses, lie.tangent_dim(graph.dim)
    usable = jnp.all(jnp.isfinite(graph.T_i_j), axis=(1, 2)) & graph.mask
    trust = jnp.where(usable, solution.edge_weight, 0)
    T = solution.T_world_i
    deviation = deviations(graph, T, trust)
    W = precisions(graph, trust, deviation)
    if graph.information is None:
        W = W / deviation[1] ** 2
    H, _ = normal_equations(graph, T, jnp.where(usable[:, None, None], W, 0))
    root = jax.lax.rsqrt(jnp.diagonal(H))
    factor = jnp.linalg.cholesky(H * root[:, None] * root[None, :])
    eye = jnp.eye(num * k, dtype=H.dtype)
    half = jax.lax.linalg.triangular_solve(factor, eye, left_side=True, lower=True)
    columns = (half * root[None, :]).reshape(num * k, num, k)
    blocks = jnp.einsum("nva,nvb->vab", columns, columns)
    touched = jnp.zeros((num,), trust.dtype)
    touched = touched.at[graph.edges[:, 0]].add(trust)
    touched = touched.at[graph.edges[:, 1]].add(trust)
    known = solution.placed & (touched > 0)
    blocks = jnp.where(known[:, None, None], blocks, jnp.nan)
    return blocks.at[0].set(0)
