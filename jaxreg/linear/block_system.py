"""Gauss-Newton systems of large graphs: Laplacians with k x k weights, never formed.

With left tangents the error of an edge changes by J (x_j - x_i): the normal equations
are B' Q B x = -B' f with Q = J' W J and f = J' W r of each edge.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.laplacian import divergence
from jaxreg.linear.multigrid import Laplacian, Multigrid


def solve_block_flow(
    matrix: Laplacian,
    force: Float[Array, "e k"],
    inverse: Multigrid,
    tolerance: float,
) -> tuple[Float[Array, "v k"], Int[Array, ""]]:
    """The x with `matrix(x) = -B' force`, and the rounds that it took.

    Pose 0 and poses that no weight holds stay.
    """
    x, rounds = conjugate_gradients(
        matrix,
        inverse,
        -divergence(matrix.edges, force, matrix.own.shape[0])[..., None],
        tolerance=tolerance,
        max_steps=300,
    )
    # Damping leaves pose 0 some of the motion that all share.
    held = jnp.trace(matrix.diagonal(), axis1=-2, axis2=-1) > 0
    return jnp.where(held[:, None], x[..., 0] - x[0, :, 0], 0), rounds
