"""An approximate inverse of graph Laplacians with k x k weights, in two levels.

The Laplacian of weights W_e is the matrix of sum_e (x_j - x_i)' W_e (x_j - x_i): scalar
weights in motion averaging, 6 x 6 ones in Gauss-Newton steps with left tangents. The
first level solves exactly within blocks of consecutive frames, the second a system with
one unknown per block, in which each block moves as one. Numbering frames along the
trajectory helps; any numbering is right.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class TwoLevel(NamedTuple):
    """The approximate inverse: call it on `(v, k, c)`, c right-hand sides."""

    blocks: Array  # (b, s k, s k) inverses of the diagonal blocks
    coarse: Array  # (b k, b k) inverse of the Galerkin matrix
    held: Array  # (v,) 1 for the frames that some weight holds, 0 for frame 0

    def __call__(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """Approximately solves for right-hand sides r."""
        num, k, c = r.shape
        b = self.blocks.shape[0]
        s = self.blocks.shape[1] // k
        padded = jnp.pad(r, [(0, b * s - num), (0, 0), (0, 0)])
        x = (self.blocks @ padded.reshape(b, s * k, c)).reshape(b, s, k, c)
        if b > 1:
            total = jnp.sum(padded.reshape(b, s, k, c), axis=1).reshape(b * k, c)
            x = x + (self.coarse @ total).reshape(b, 1, k, c)
        return x.reshape(b * s, k, c)[:num] * self.held[:, None, None]


def two_level(
    edges: Int[Array, "e 2"],
    weight: Float[Array, "e k k"],
    num_poses: int,
    block: int,
    extra: Float[Array, "v k k"] | None = None,
) -> TwoLevel:
    """The approximate inverse, with frame 0 held.

    Args:
        edges: `(e, 2)` frames.
        weight: `(e, k, k)` positive semidefinite weights.
        num_poses: number of frames.
        block: frames in a block; exact if it holds them all.
        extra: `(v, k, k)` added to the diagonal, or None.
    """
    k, s = weight.shape[-1], min(block, num_poses)
    b = -(-num_poses // s)
    i, j = edges[:, 0], edges[:, 1]
    bi, bj, li, lj = i // s, j // s, i % s, j % s
    same = jnp.where((bi == bj)[:, None, None], weight, 0)
    blocks = jnp.zeros((b, s, k, s, k), weight.dtype)
    blocks = blocks.at[bi, li, :, li].add(weight).at[bj, lj, :, lj].add(weight)
    blocks = blocks.at[bi, li, :, lj].add(-same).at[bj, lj, :, li].add(-same)
    across = weight - same
    coarse = jnp.zeros((b, k, b, k), weight.dtype)
    coarse = coarse.at[bi, :, bi].add(across).at[bj, :, bj].add(across)
    coarse = coarse.at[bi, :, bj].add(-across).at[bj, :, bi].add(-across)
    touched = jnp.zeros((num_poses,), weight.dtype)
    trace = jnp.trace(weight, axis1=-2, axis2=-1)
    touched = touched.at[i].add(trace).at[j].add(trace)
    if extra is not None:
        frames = jnp.arange(num_poses)
        blocks = blocks.at[frames // s, frames % s, :, frames % s].add(extra)
        coarse = coarse.at[frames // s, :, frames // s].add(extra)
    # Frame 0 is tied to the ground, which also fixes the level of the coarse system.
    at_ground = ((i == 0) | (j == 0))[:, None, None]
    ground = jnp.sum(jnp.where(at_ground, weight, 0), axis=0)
    blocks = blocks.at[0, 0, :, 0].add(ground)
    coarse = coarse.at[0, :, 0].add(ground)
    held = (touched > 0).at[0].set(False).astype(weight.dtype)
    return TwoLevel(
        ridged_inverse(blocks.reshape(b, s * k, s * k)),
        ridged_inverse(coarse.reshape(b * k, b * k)),
        held,
    )


def ridged_inverse(A: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverses of semidefinite matrices whose empty rows are left alone."""
    n = A.shape[-1]
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    # A unit diagonal first, so that parts in other units keep their digits.
    root = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    scaled = A * root[..., :, None] * root[..., None, :]
    eye = jnp.eye(n, dtype=A.dtype)
    ridge = jnp.where(diagonal > 0, 30 * jnp.finfo(A.dtype).eps, 1)
    factor = jnp.linalg.cholesky(scaled + ridge[..., None] * eye)
    eyes = jnp.broadcast_to(eye, A.shape)
    half = jax.lax.linalg.triangular_solve(factor, eyes, left_side=True, lower=True)
    inverse = jnp.swapaxes(half, -1, -2) @ half
    return inverse * root[..., :, None] * root[..., None, :]
