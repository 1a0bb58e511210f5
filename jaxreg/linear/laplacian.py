"""The weighted Laplacian system of motion averaging: one unknown per frame.

The least-squares solution of D A = dV (MCC paper, Eq. 17-20) needs the v x v Laplacian
B' B with k right-hand sides and never a k v x k v matrix. Frame 0 is held at 0.

Up to `DENSE_LIMIT` frames the matrix is formed and solved by `jnp.linalg.lstsq`; above,
conjugate gradients work on the edges. Any numbering of frames is right.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg.linear.operator import GraphLaplacian, divergence
from jaxreg.linear.solvers import (
    AbstractSymmetricSolver,
    LeastSquares,
    MultigridCG,
    RidgedCholesky,
)


#: Largest number of frames for which a dense matrix over frames is formed.
DENSE_LIMIT = 128


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
    solve = _prepared(edges, w, num_poses, RidgedCholesky(), tolerance)
    return lambda flow: solve(divergence(edges, w[:, None] * flow, num_poses))


def solve_laplacian(
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    rhs: Float[Array, "v k"],
    tolerance: float = 0.0,
) -> Float[Array, "v k"]:
    """The x with x_0 = 0 and B' W B x = rhs but for row 0; weights of at most 1."""
    return _prepared(edges, weight, len(rhs), LeastSquares(), tolerance)(rhs)


def _relative(weight: Array) -> Array:
    """Weights of at most 1: no power of them can underflow the whole system."""
    top = jnp.max(weight)
    return weight / jnp.where(top > 0, top, 1)


def _prepared(
    edges: Array,
    weight: Array,
    num_poses: int,
    dense: AbstractSymmetricSolver,
    tolerance: float,
) -> Callable[[Array], Array]:
    """The solution of the system, by `dense` up to `DENSE_LIMIT` frames."""
    matrix = GraphLaplacian.anchored(edges, weight[:, None, None], num_poses)
    solver = solver_for(num_poses, dense, tolerance)
    state = solver.init(matrix, {})

    def solve(rhs: Array) -> Array:
        # What arrives at frame 0 leaves the others: then its tie bears nothing.
        rhs = rhs.at[0].set(-jnp.sum(rhs[1:], axis=0))
        x = solver.compute(state, rhs[:, None, :], {})[0][:, 0]
        return x.at[0].set(0)

    return solve


def solver_for(
    num_poses: int, dense: AbstractSymmetricSolver, tolerance: float = 0.0
) -> AbstractSymmetricSolver:
    """`dense` up to `DENSE_LIMIT` frames, above gradients to a relative tolerance."""
    return dense if num_poses <= DENSE_LIMIT else MultigridCG(tolerance)


def laplacian(
    edges: Int[Array, "e 2"], weight: Float[Array, " e"], num_poses: int
) -> Float[Array, "v v"]:
    """B' W B, with the row and column of frame 0 replaced by those of the identity."""
    none = jnp.zeros((num_poses, 1, 1), weight.dtype)
    L = GraphLaplacian(edges, weight[:, None, None], none).dense()
    return L.at[0].set(0).at[:, 0].set(0).at[0, 0].set(1)
