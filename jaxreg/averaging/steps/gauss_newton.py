"""Gauss-Newton steps on the weighted tangent errors, all k v unknowns together.

Motion averaging solves for rotations and translations side by side, which is fast and
nearly right; here each part counts at its own precision.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import product


def normal_equations(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    precision: Float[Array, "e k k"],
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """J' W J and J' W r of the errors log(inv(T_i_j) inv(T_world_i) T_world_j).

    Unknowns are right tangents, T_world_i exp(x_i). To first order in the residual
    the error changes by x_j - Ad(inv(T_world_j) T_world_i) x_i. Rows and columns of
    frame 0, and of frames that nothing holds, are those of the identity.
    """
    num, k = graph.num_poses, precision.shape[-1]
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    J, error = _linearised(graph, T_world_i)
    WJ = product(precision, J)
    JWJ = product(jnp.swapaxes(J, -1, -2), WJ)
    # Scattered into their places, with the diagonal halved: a transpose adds the rest.
    ends, frame = jnp.concatenate([i, j]), jnp.arange(num)
    own = jax.ops.segment_sum(jnp.concatenate([JWJ, precision]), ends, num)
    side = jnp.zeros((num, k, num, k), J.dtype).at[j, :, i, :].add(WJ)
    g = _pulled(graph, J, precision, error)
    free = jnp.trace(own, axis1=-2, axis2=-1) > 0
    free = jnp.repeat(free.at[0].set(False), k)
    half = side.at[frame, :, frame, :].add(own / 2).reshape(num * k, num * k)
    H = half + half.T
    H = jnp.where(free[:, None] & free[None, :], H, 0)
    held = (~free).astype(H.dtype)
    return H + jnp.diag(held), jnp.where(free, g.reshape(-1), 0)


def forces(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], precision: Float[Array, "e k k"]
) -> Float[Array, "v k"]:
    """J' W r, by frame."""
    J, error = _linearised(graph, T_world_i)
    return _pulled(graph, J, precision, error)


def _pulled(graph: PoseGraph, J: Array, precision: Array, error: Array) -> Array:
    We = product(precision, error[..., None])[..., 0]
    g = jnp.zeros((graph.num_poses, error.shape[-1]), error.dtype)
    g = g.at[graph.edges[:, 1]].add(We)
    return g.at[graph.edges[:, 0]].add(product(We[:, None], J)[:, 0])


def _linearised(graph: PoseGraph, T_world_i: Array) -> tuple[Array, Array]:
    """The derivative of the errors with respect to x_i, and the errors.

    That with respect to x_j is the identity.
    """
    T_j_i = lie.inverse(graph.predicted(T_world_i))
    return -lie.adjoint(T_j_i), graph.tangent_errors(T_world_i)


def precisions(
    graph: PoseGraph, trust: Float[Array, " e"], width: Float[Array, "2"]
) -> Float[Array, "e k k"]:
    """Weight times trust times the information of each edge.

    Without information, every edge has that of noise in proportion to the widths,
    with 1 for rotations.
    """
    w = (graph.weight * trust)[:, None, None]
    if graph.information is not None:
        return w * graph.information
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    shift = jnp.full((d,), (width[1] / width[0]) ** 2)
    parts = jnp.concatenate([shift, jnp.ones((k - d,), shift.dtype)])
    return w * jnp.diag(parts)[None]


def gauss_newton_step(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    trust: Float[Array, " e"],
    width: Float[Array, "2"],
) -> Float[Array, "v D D"]:
    """The poses after one step, from a dense Cholesky factor of the normal equations.

    The system is scaled to a unit diagonal, which makes it safe in float32.
    """
    precision = precisions(graph, trust, width)
    H, g = normal_equations(graph, T_world_i, precision)
    inverse_root = jax.lax.rsqrt(jnp.diagonal(H))
    scaled = H * inverse_root[:, None] * inverse_root[None, :]
    ridge = 100 * jnp.finfo(H.dtype).eps
    factor = jnp.linalg.cholesky(scaled + ridge * jnp.eye(len(g), dtype=H.dtype))
    y = jax.lax.linalg.triangular_solve(
        factor, (inverse_root * g)[:, None], left_side=True, lower=True
    )
    x = jax.lax.linalg.triangular_solve(
        factor, y, left_side=True, lower=True, transpose_a=True
    )
    tangent = -(inverse_root * x[:, 0]).reshape(graph.num_poses, -1)
    return product(T_world_i, lie.exp(tangent))
