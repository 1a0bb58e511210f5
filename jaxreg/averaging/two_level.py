"""An approximate inverse of graph Laplacians with k x k weights, in two levels.

The Laplacian of weights W_e is the matrix of sum_e (x_j - x_i)' W_e (x_j - x_i): scalar
weights in motion averaging, 6 x 6 ones in Gauss-Newton steps with left tangents. The
first level solves exactly within blocks of consecutive frames; the second, exactly
among motions that are linear in the number of the frame between nodes at equal
distances. (Nodes must be dense: a chain bends easily between them. Levels between the
two gained nothing on graphs whose closures join distant frames.) Numbering frames along
the trajectory helps; any numbering is right.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class TwoLevel(NamedTuple):
    """The approximate inverse: call it on `(v, k, c)`, c right-hand sides."""

    blocks: Array  # (b, s k, s k) inverses of the diagonal blocks
    coarse: Array  # (m k, m k) inverse of the Galerkin matrix of m nodes
    held: Array  # (v,) 1 for the frames that some weight holds, 0 for frame 0

    def __call__(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """Approximately solves for right-hand sides r."""
        num, k, c = r.shape
        b = self.blocks.shape[0]
        s = self.blocks.shape[1] // k
        padded = jnp.pad(r, [(0, b * s - num), (0, 0), (0, 0)])
        x = (self.blocks @ padded.reshape(b, s * k, c)).reshape(b * s, k, c)[:num]
        if b > 1:
            x = x + self._smooth(r)
        return x * self.held[:, None, None]

    def _smooth(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        num, k, c = r.shape
        cells = self.coarse.shape[0] // k - 1
        s = -(-num // cells)
        padded = jnp.pad(r, [(0, cells * s - num), (0, 0), (0, 0)])
        padded = padded.reshape(cells, s, k, c)
        far = (jnp.arange(s, dtype=r.dtype) / s)[:, None, None]
        near = jnp.sum((1 - far) * padded, axis=1)
        total = jnp.pad(near, [(0, 1), (0, 0), (0, 0)])
        total = total.at[1:].add(jnp.sum(far * padded, axis=1))
        y = (self.coarse @ total.reshape(-1, c)).reshape(cells + 1, k, c)
        x = (1 - far) * y[:-1, None] + far * y[1:, None]
        return x.reshape(cells * s, k, c)[:num]


def two_level(
    edges: Int[Array, "e 2"],
    weight: Float[Array, "e k k"],
    num_poses: int,
    block: int,
    spacing: int,
    extra: Float[Array, "v k k"] | None = None,
) -> TwoLevel:
    """The approximate inverse, with frame 0 held.

    Args:
        edges: `(e, 2)` frames.
        weight: `(e, k, k)` positive semidefinite weights.
        num_poses: number of frames.
        block: frames in a block; exact if it holds them all.
        spacing: frames from one node of the coarse system to the next.
        extra: `(v, k, k)` added to the diagonal, or None.
    """
    k, s = weight.shape[-1], min(block, num_poses)
    b = -(-num_poses // s)
    i, j = edges[:, 0], edges[:, 1]
    bi, bj, li, lj = i // s, j // s, i % s, j % s
    # Frame 0 stays: its edges tie the other frame to the ground.
    apart = (bi != bj) | (i == 0) | (j == 0)
    same = jnp.where(apart[:, None, None], 0, weight)
    blocks = jnp.zeros((b, s, k, s, k), weight.dtype)
    blocks = blocks.at[bi, li, :, li].add(weight).at[bj, lj, :, lj].add(weight)
    blocks = blocks.at[bi, li, :, lj].add(-same).at[bj, lj, :, li].add(-same)
    if extra is not None:
        frames = jnp.arange(num_poses)
        blocks = blocks.at[frames // s, frames % s, :, frames % s].add(extra)
    touched = jnp.zeros((num_poses,), weight.dtype)
    trace = jnp.trace(weight, axis1=-2, axis2=-1)
    touched = touched.at[i].add(trace).at[j].add(trace)
    held = (touched > 0).at[0].set(False).astype(weight.dtype)
    coarse = jnp.zeros((0, 0), weight.dtype)
    if b > 1:
        coarse = _coarse(edges, weight, num_poses, spacing, extra)
    return TwoLevel(
        ridged_inverse(blocks.reshape(b, s * k, s * k)), ridged_inverse(coarse), held
    )


def _coarse(
    edges: Array, weight: Array, num_poses: int, spacing: int, extra: Array | None
) -> Float[Array, "n n"]:
    """The Galerkin matrix of the functions that are linear between nodes."""
    k, cells = weight.shape[-1], -(-num_poses // spacing)
    s = -(-num_poses // cells)
    frame = jnp.arange(num_poses)
    node = jnp.stack([frame // s, frame // s + 1], axis=1)
    far = (frame % s).astype(weight.dtype) / s
    share = jnp.stack([1 - far, far], axis=1).at[0].set(0)
    i, j = edges[:, 0], edges[:, 1]
    nodes = jnp.concatenate([node[j], node[i]], axis=1)
    shares = jnp.concatenate([share[j], -share[i]], axis=1)
    start = jnp.zeros((cells + 1, k, cells + 1, k), weight.dtype)

    # One pair of corners at a time, as all sixteen would take much memory.
    def add(p: Array, C: Array) -> Array:
        a, b = p // 4, p % 4
        both = (shares[:, a] * shares[:, b])[:, None, None]
        return C.at[nodes[:, a], :, nodes[:, b]].add(both * weight)

    C = jax.lax.fori_loop(0, 16, add, start)
    if extra is not None:
        for a in range(2):
            for b in range(2):
                both = (share[:, a] * share[:, b])[:, None, None]
                C = C.at[node[:, a], :, node[:, b]].add(both * extra)
    return C.reshape((cells + 1) * k, (cells + 1) * k)


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
