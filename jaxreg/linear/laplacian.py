"""The weighted Laplacian system of motion averaging: one unknown per frame.

The stacked system D A = dV of the MCC paper (Eq. 17-20) has D = B (x) I_k with B the
weighted incidence matrix, so its least-squares solution needs the v x v Laplacian
B' B with k right-hand sides and never a k v x k v matrix. Frame 0 is held at 0.

Up to `DENSE_LIMIT` frames the matrix is formed; above, conjugate gradients work on the
edges, preconditioned by a multigrid cycle. Any numbering of frames is right.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.multigrid import anchored, multigrid, ridged_factor


#: Largest number of frames for which a dense matrix over frames is formed.
DENSE_LIMIT = 128


def divergence(
    edges: Int[Array, "e 2"], flow: Float[Array, "e k"], num_poses: int
) -> Float[Array, "v k"]:
    """B' flow: what arrives at each frame minus what leaves it."""
    out = jnp.zeros((num_poses, *flow.shape[1:]), flow.dtype)
    return out.at[edges[:, 1]].add(flow).at[edges[:, 0]].add(-flow)


def solve_flow(
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    flow: Float[Array, "e k"],
    num_poses: int,
    tolerance: float = 0.0,
) -> Float[Array, "v k"]:
    """The x with x_0 = 0 that minimises sum_e weight_e |x_j - x_i - flow_e|^2.

    Frames that no weight holds stay at 0 (the solution of least norm). Graphs above
    `DENSE_LIMIT` are solved to a relative `tolerance`, at best that of the dtype.
    """
    w = _relative(weight)
    rhs = divergence(edges, w[:, None] * flow, num_poses)
    return solve_laplacian(edges, w, rhs, tolerance)


def flow_solver(
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    num_poses: int,
    tolerance: float,
) -> Callable[[Float[Array, "e k"]], Float[Array, "v k"]]:
    """`solve_flow` for many flows under the same weights, prepared once.

    Every frame must be joined to frame 0 or have no weight at all.
    """
    w = _relative(weight)
    if num_poses <= DENSE_LIMIT:
        solve = _direct(edges, w, num_poses)
    else:
        solve = _iterative(edges, w, num_poses, tolerance)
    return lambda flow: solve(divergence(edges, w[:, None] * flow, num_poses))


def _relative(weight: Array) -> Array:
    """Weights of at most 1: no power of them can underflow the whole system."""
    top = jnp.max(weight)
    return weight / jnp.where(top > 0, top, 1)


def solve_laplacian(
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    rhs: Float[Array, "v k"],
    tolerance: float = 0.0,
) -> Float[Array, "v k"]:
    """The x with x_0 = 0 and B' W B x = rhs but for row 0; weights of at most 1."""
    num = rhs.shape[0]
    if num <= DENSE_LIMIT:
        return jnp.linalg.lstsq(laplacian(edges, weight, num), rhs.at[0].set(0))[0]
    return _iterative(edges, weight, num, tolerance)(rhs)


def _direct(edges: Array, weight: Array, num_poses: int) -> Callable[[Array], Array]:
    factor, root = ridged_factor(laplacian(edges, weight, num_poses))
    root = root[:, None]

    # Not by an inverse: with many right-hand sides BLAS starts threads, which take
    # longer to meet than to work.
    def solve(rhs: Array) -> Array:
        half = root * rhs.at[0].set(0)
        return root * jax.scipy.linalg.cho_solve((factor, True), half)

    return solve


def _iterative(
    edges: Array, weight: Array, num_poses: int, tolerance: float
) -> Callable[[Array], Array]:
    """Preconditioned conjugate gradients, the k columns side by side."""
    matrix = anchored(edges, weight[:, None, None], num_poses)
    inverse = multigrid(matrix)
    least = 3 * float(jnp.finfo(weight.dtype).eps)

    def solve(rhs: Array) -> Array:
        # What arrives at frame 0 leaves the others.
        rhs = rhs.at[0].set(-jnp.sum(rhs[1:], axis=0))
        x = conjugate_gradients(
            matrix,
            inverse,
            rhs[:, None, :],
            tolerance=max(tolerance, least),
            max_steps=500,
        )[0][:, 0]
        return x.at[0].set(0)

    return solve


def laplacian(
    edges: Int[Array, "e 2"], weight: Float[Array, " e"], num_poses: int
) -> Float[Array, "v v"]:
    """B' W B, with the row and column of frame 0 replaced by those of the identity."""
    i, j = edges[:, 0], edges[:, 1]
    L = jnp.zeros((num_poses, num_poses), weight.dtype)
    L = L.at[i, i].add(weight).at[j, j].add(weight)
    L = L.at[i, j].add(-weight).at[j, i].add(-weight)
    return L.at[0].set(0).at[:, 0].set(0).at[0, 0].set(1)
