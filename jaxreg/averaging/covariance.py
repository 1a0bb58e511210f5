"""How well a graph determines the poses that were averaged from it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.checks import check_count, shown
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.steps.gauss_newton import normal_equations, precisions
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, check_graph, check_poses


def pose_covariances(
    graph: PoseGraph, solution: AveragingSolution, *, max_unknowns: int = 6000
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

    Returns:
        `(v, k, k)`; 0 for frame 0, NaN for frames that no trusted edge holds.

    Raises:
        ValueError: for more unknowns than `max_unknowns`, and for a solution of another
            graph.
        TypeError: for anything but a graph and a solution.

    Gradients: none (cut).
    """
    check_solution(graph, solution)
    check_count(max_unknowns, "max_unknowns")
    k = lie.tangent_dim(graph.dim)
    if graph.num_poses * k > max_unknowns:
        raise ValueError(
            f"graph: wanted at most {max_unknowns // k} poses for covariances, "
            f"found {graph.num_poses}."
        )
    return _covariances(graph, solution)


def check_solution(graph: PoseGraph, solution: AveragingSolution) -> None:
    """Requires a graph and a solution of it."""
    check_graph(graph, "graph")
    if not isinstance(solution, AveragingSolution):
        raise TypeError(
            f"solution: wanted an AveragingSolution, found {shown(solution)}."
        )
    check_poses(solution.T_world_i, "solution: T_world_i", graph)
    if solution.edge_weight.shape != graph.weight.shape:
        raise ValueError(
            f"solution: wanted one of {graph.num_edges} edges, found "
            f"{solution.edge_weight.shape}."
        )


@eqx.filter_jit
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


def deviations(graph: PoseGraph, T: Array, trust: Array) -> Float[Array, "2"]:
    """Of one component of a translation and of a rotation, by the trusted edges."""
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    rotation, translation = graph.differences(T)
    w = graph.weight * trust
    count = jnp.sum(jnp.where(graph.mask, trust, 0))
    spare = jnp.maximum(count - (graph.num_poses - 1), 1)
    mean = jnp.stack(
        [
            jnp.sum(w * jnp.where(w > 0, translation, 0)) / d,
            jnp.sum(w * jnp.where(w > 0, rotation, 0)) / (2 * (k - d)),
        ]
    )
    return jnp.maximum(jnp.sqrt(mean / spare), 8 * jnp.finfo(T.dtype).eps)
