"""The weighted Laplacian system of motion averaging: one unknown per frame.

The stacked system D A = dV of the MCC paper (Eq. 17-20) has D = B (x) I_k with B the
weighted incidence matrix, so its least-squares solution needs the v x v Laplacian
B' B with k right-hand sides and never a k v x k v matrix. Frame 0 is held at 0.

Up to `DENSE_LIMIT` frames the matrix is formed; above, conjugate gradients work on the
edges, preconditioned by two levels: exact solves in blocks of consecutive frames and a
coarse system with one unknown per block. Numbering frames along the trajectory helps
them; any numbering is right.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


#: Largest number of frames for which a dense matrix over frames is formed.
DENSE_LIMIT = 128
_BLOCK = 64


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
) -> Float[Array, "v k"]:
    """The x with x_0 = 0 that minimises sum_e weight_e |x_j - x_i - flow_e|^2.

    Frames that no weight holds stay at 0 (the solution of least norm).
    """
    # The weights are relative: no power of them can underflow the whole system.
    top = jnp.max(weight)
    w = weight / jnp.where(top > 0, top, 1)
    return solve_laplacian(edges, w, divergence(edges, w[:, None] * flow, num_poses))


def solve_laplacian(
    edges: Int[Array, "e 2"], weight: Float[Array, " e"], rhs: Float[Array, "v k"]
) -> Float[Array, "v k"]:
    """The x with x_0 = 0 and B' W B x = rhs but for row 0; weights of at most 1."""
    rhs = rhs.at[0].set(0)
    if rhs.shape[0] <= DENSE_LIMIT:
        return jnp.linalg.lstsq(laplacian(edges, weight, rhs.shape[0]), rhs)[0]
    return _conjugate_gradients(edges, weight, rhs)


def laplacian(
    edges: Int[Array, "e 2"], weight: Float[Array, " e"], num_poses: int
) -> Float[Array, "v v"]:
    """B' W B, with the row and column of frame 0 replaced by those of the identity."""
    i, j = edges[:, 0], edges[:, 1]
    L = jnp.zeros((num_poses, num_poses), weight.dtype)
    L = L.at[i, i].add(weight).at[j, j].add(weight)
    L = L.at[i, j].add(-weight).at[j, i].add(-weight)
    return L.at[0].set(0).at[:, 0].set(0).at[0, 0].set(1)


class TwoLevel(NamedTuple):
    """Exact solves in blocks plus a coarse solve: call it on `(v, k)`."""

    blocks: Array  # (b, s, s) inverses of the diagonal blocks
    coarse: Array  # (b, b) inverse of the Galerkin matrix
    held: Array  # (v, 1) 1 for the frames that some weight holds, 0 for frame 0

    def __call__(self, r: Array) -> Array:
        """Approximately solves for right-hand sides r."""
        num_poses, k = r.shape
        b, s, _ = self.blocks.shape
        padded = jnp.pad(r, [(0, b * s - num_poses), (0, 0)]).reshape(b, s, k)
        fine = self.blocks @ padded
        lift = self.coarse @ jnp.sum(padded, axis=1)
        both = fine + lift[:, None, :]
        return both.reshape(b * s, k)[:num_poses] * self.held


def two_level(edges: Array, weight: Array, num_poses: int) -> TwoLevel:
    """An approximate inverse of the Laplacian, with frame 0 held."""
    s = _BLOCK
    b = -(-num_poses // s)
    i, j = edges[:, 0], edges[:, 1]
    bi, bj, li, lj = i // s, j // s, i % s, j % s
    same = jnp.where(bi == bj, weight, 0)
    blocks = jnp.zeros((b, s, s), weight.dtype)
    blocks = blocks.at[bi, li, li].add(weight).at[bj, lj, lj].add(weight)
    blocks = blocks.at[bi, li, lj].add(-same).at[bi, lj, li].add(-same)
    across = weight - same
    coarse = jnp.zeros((b, b), weight.dtype)
    coarse = coarse.at[bi, bi].add(across).at[bj, bj].add(across)
    coarse = coarse.at[bi, bj].add(-across).at[bj, bi].add(-across)
    # Frame 0 is tied to the ground, which also fixes the level of the coarse system.
    ground = jnp.sum(jnp.where((i == 0) | (j == 0), weight, 0))
    blocks = blocks.at[0, 0, 0].add(ground)
    coarse = coarse.at[0, 0].add(ground)
    touched = jnp.zeros((num_poses,), weight.dtype).at[i].add(weight).at[j].add(weight)
    held = (touched > 0).at[0].set(False).astype(weight.dtype)[:, None]
    return TwoLevel(_ridged_inverse(blocks), _ridged_inverse(coarse), held)


def _ridged_inverse(A: Array) -> Array:
    """Inverses of semidefinite matrices whose empty rows are left alone."""
    n = A.shape[-1]
    eye = jnp.eye(n, dtype=A.dtype)
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    ridge = jnp.where(diagonal > 0, diagonal * 30 * jnp.finfo(A.dtype).eps, 1)
    factor = jnp.linalg.cholesky(A + ridge[..., None] * eye)
    eyes = jnp.broadcast_to(eye, A.shape)
    half = jax.lax.linalg.triangular_solve(factor, eyes, left_side=True, lower=True)
    return jnp.swapaxes(half, -1, -2) @ half


class _CG(NamedTuple):
    x: Array
    r: Array
    p: Array
    rz: Array
    step: Array


def _conjugate_gradients(edges: Array, weight: Array, rhs: Array) -> Array:
    """Preconditioned conjugate gradients, the k columns side by side."""
    num_poses = rhs.shape[0]
    i, j = edges[:, 0], edges[:, 1]
    precondition = two_level(edges, weight, num_poses)

    def apply(x: Array) -> Array:
        return (
            divergence(edges, weight[:, None] * (x[j] - x[i]), num_poses).at[0].set(0)
        )

    tolerance = 10 * jnp.finfo(rhs.dtype).eps ** 2
    z = precondition(rhs)
    rz = jnp.sum(rhs * z, axis=0)
    stop = jnp.maximum(tolerance * rz, jnp.finfo(rhs.dtype).tiny)

    def unfinished(s: _CG) -> Array:
        return jnp.any(s.rz > stop) & (s.step < 500)

    def step(s: _CG) -> _CG:
        Ap = apply(s.p)
        pAp = jnp.sum(s.p * Ap, axis=0)
        alive = (pAp > 0) & (s.rz > stop)
        a = jnp.where(alive, s.rz / jnp.where(alive, pAp, 1), 0)
        x, r = s.x + a * s.p, s.r - a * Ap
        z = precondition(r)
        rz = jnp.where(alive, jnp.sum(r * z, axis=0), 0)
        beta = jnp.where(alive, rz / jnp.where(alive, s.rz, 1), 0)
        return _CG(x, r, z + beta * s.p, rz, s.step + 1)

    zero = jnp.zeros_like(rhs)
    begin = _CG(zero, rhs, z, rz, jnp.asarray(0, jnp.int32))
    return jax.lax.while_loop(unfinished, step, begin).x
