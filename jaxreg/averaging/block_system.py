"""Gauss-Newton systems of large graphs: Laplacians with k x k weights, never formed.

With left tangents the error of an edge changes by J (x_j - x_i): the normal equations
are B' Q B x = -B' f with Q = J' W J and f = J' W r of each edge.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg.averaging.krylov import conjugate_gradients
from jaxreg.averaging.laplacian import divergence
from jaxreg.averaging.two_level import TwoLevel, two_level


# Unknowns below which the inverse is exact, in one of its blocks, and at most in its
# coarse system; and frames between two nodes of that.
_EXACT, _BLOCK, _COARSE, _SPACING = 384, 48, 1500, 16


def block_diagonal(
    edges: Int[Array, "e 2"], Q: Float[Array, "e k k"], num_poses: int
) -> Float[Array, "v k k"]:
    """The diagonal blocks of B' Q B."""
    zero = jnp.zeros((num_poses, *Q.shape[1:]), Q.dtype)
    return zero.at[edges[:, 0]].add(Q).at[edges[:, 1]].add(Q)


def block_inverse(
    edges: Int[Array, "e 2"],
    Q: Float[Array, "e k k"],
    num_poses: int,
    damping: Float[Array, ""] | float,
) -> TwoLevel:
    """About the inverse of H + damping diag(H), H = B' Q B, with frame 0 held."""
    size = num_poses * Q.shape[-1]
    block = num_poses if size <= _EXACT else _BLOCK // Q.shape[-1]
    spacing = max(_SPACING, -(-size // _COARSE))
    extra = damping * block_diagonal(edges, Q, num_poses)
    return two_level(edges, Q, num_poses, block, spacing, extra)


def solve_block_flow(
    edges: Int[Array, "e 2"],
    Q: Float[Array, "e k k"],
    force: Float[Array, "e k"],
    inverse: TwoLevel,
    damping: Float[Array, ""] | float,
    tolerance: float,
) -> tuple[Float[Array, "v k"], Int[Array, ""]]:
    """-(H + damping diag(H))^-1 B' force with x_0 = 0, and the rounds that it took."""
    num = inverse.held.shape[0]
    i, j = edges[:, 0], edges[:, 1]
    extra = damping * block_diagonal(edges, Q, num)

    def apply(x: Array) -> Array:
        flow = jnp.einsum("eab,eb->ea", Q, x[j] - x[i])
        own = jnp.sum(extra * x[:, None, :], axis=-1)
        return (divergence(edges, flow, num) + own).at[0].set(0)

    return conjugate_gradients(
        apply,
        lambda r: inverse(r[..., None])[..., 0],
        -divergence(edges, force, num).at[0].set(0),
        columns=False,
        tolerance=tolerance,
        max_steps=300,
    )
