"""An approximate inverse of graph Laplacians with k x k weights: a multigrid cycle.

Motions that all frames share cost nothing, so frames that are held together
strongly move as one on the next level, whose matrix is again a graph Laplacian, and
the last, of some tens of frames, is inverted. Frames are paired by the strength of
their edges, not by their number: bending a long chain costs little beside stretching
it, and pieces of frames that bend apart must not be fixed to each other.

Pieces that move as one are too stiff by about a constant at each level; two steps of
conjugate gradients on each find the right lengths (the K-cycle).

By hand: PyAMG runs on the host, where neither `jit` nor new weights reach it.

Reference: Notay, An aggregation-based algebraic multigrid method, ETNA 37, 2010.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg.linear.aggregation import RATIO, Aggregates, aggregate
from jaxreg.linear.carried import carried, carried_back, stiffness_carried_back
from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.small import inverse_semidefinite, product


# Unknowns up to which a matrix is inverted; steps on each coarser level.
_EXACT, _INNER = 384, 2
# A share of the Jacobi step; at 1, it stands still at the largest eigenvalue, 2.
_DAMPED = 0.75


class _Level(NamedTuple):
    matrix: GraphLaplacian
    jacobi: Array  # (v, k, k) the damped Jacobi step; 0 for frames that nothing holds
    parent: Array  # (v,) frames of the next level
    held: Array  # (v,) 1, or 0 for frames that nothing holds
    lever: Array | None  # (v, d) from the point of the parent, if there are points

    def restricted(self, r: Array, num: int) -> Array:
        """Forces on the `num` frames of the next level."""
        if self.lever is not None:
            r = carried_back(r, self.lever)
        return jnp.zeros((num, *r.shape[1:]), r.dtype).at[self.parent].add(r)

    def prolonged(self, x: Array) -> Array:
        """Velocities of frames that move as their parents do."""
        x = x[self.parent]
        return x if self.lever is None else carried(x, self.lever)


class Multigrid(NamedTuple):
    """The approximate inverse: call it on `(v, k, c)`, c right-hand sides."""

    levels: tuple[_Level, ...]
    bottom: Array  # (m k, m k) inverse of the last matrix

    def __call__(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """Approximately solves for right-hand sides r, each by itself."""
        return self._cycle(0, r)

    def _cycle(self, number: int, r: Array) -> Array:
        if number == len(self.levels):
            return (self.bottom @ r.reshape(-1, r.shape[-1])).reshape(r.shape)
        level = self.levels[number]
        held = level.held[:, None, None]
        x = product(level.jacobi, r)
        left = held * (r - level.matrix.mv(x))
        x = x + held * level.prolonged(self._below(number + 1, left))
        return x + product(level.jacobi, r - level.matrix.mv(x))

    def _below(self, number: int, r: Array) -> Array:
        """The solution on the next level."""
        last = number == len(self.levels)
        k = r.shape[1]
        num = self.bottom.shape[0] // k if last else self.levels[number].held.shape[0]
        total = self.levels[number - 1].restricted(r, num)
        if last:
            return self._cycle(number, total)
        return conjugate_gradients(
            self.levels[number].matrix.mv,
            lambda r: self._cycle(number, r),
            total,
            tolerance=0.0,
            max_steps=_INNER,
        )[0]


def multigrid(matrix: GraphLaplacian) -> Multigrid:
    """The approximate inverse of a matrix of positive semidefinite weights."""
    levels = []
    k = matrix.own.shape[-1]
    while matrix.own.shape[0] * k > _EXACT:
        level, matrix = _coarser(matrix)
        levels.append(level)
    return Multigrid(tuple(levels), ridged_inverse(matrix.dense()))


def _coarser(matrix: GraphLaplacian) -> tuple[_Level, GraphLaplacian]:
    """A level and the matrix of the next."""
    edges, weight, own = matrix.edges, matrix.weight, matrix.own
    k = own.shape[-1]
    i, j = edges[:, 0], edges[:, 1]
    diagonal = matrix.blocks()
    held = jnp.trace(diagonal, axis1=-2, axis2=-1) > 0
    inverse = block_inverses(diagonal)
    # The share of each edge in what holds its frames, whatever the coordinates.
    share = jnp.minimum(
        jnp.sum(inverse[i] * matrix.weight_at_i(), axis=(1, 2)),
        jnp.sum(inverse[j] * weight, axis=(1, 2)),
    )
    share = jnp.where(i == j, 0, jnp.maximum(share, 0))
    agg = aggregate(edges, share, own.shape[0])
    count = -(-own.shape[0] // RATIO)
    lever, origin, crossing = None, None, weight
    if matrix.origin is not None:
        origin = _middles(matrix.origin, agg.parent, count)
        lever = matrix.origin - origin[agg.parent]
        own = stiffness_carried_back(own, lever)
        # An edge between aggregates may point the other way.
        head = agg.edges[jnp.minimum(agg.slot, len(agg.edges) - 1), 1]
        crossing = stiffness_carried_back(weight, matrix.origin[j] - origin[head])
    blocks = jnp.zeros((agg.edges.shape[0], k, k), own.dtype)
    blocks = blocks.at[agg.slot].add(crossing, mode="drop")
    own = jnp.zeros((count, k, k), own.dtype).at[agg.parent].add(own)
    # Edges without room tie both ends to the ground: at least half as stiff, and stiff
    # where both ends move alike, so still safe.
    own = control.cond(
        jnp.any(agg.lost),
        lambda: own + _grounded(matrix, agg, origin, count),
        lambda: own,
    )
    held = held.astype(own.dtype)
    level = _Level(matrix, _DAMPED * inverse, agg.parent, held, lever)
    return level, GraphLaplacian(agg.edges, blocks, own, origin)


def _grounded(
    matrix: GraphLaplacian, agg: Aggregates, origin: Array | None, count: int
) -> Float[Array, "c k k"]:
    """The stiffness of edges that found no room, at both ends."""
    W = jnp.where(agg.lost[:, None, None], matrix.weight, 0)
    out = jnp.zeros((count, *W.shape[1:]), W.dtype)
    for end in agg.parent[matrix.edges].T:
        at_end = W
        if origin is not None and matrix.origin is not None:
            shift = matrix.origin[matrix.edges[:, 1]] - origin[end]
            at_end = stiffness_carried_back(W, shift)
        out = out.at[end].add(at_end)
    return out


def _middles(
    points: Float[Array, "v d"], parent: Int[Array, " v"], count: int
) -> Float[Array, "c d"]:
    """The mean point of the frames of each aggregate."""
    num = jnp.zeros((count,), points.dtype).at[parent].add(1)
    total = jnp.zeros((count, points.shape[1]), points.dtype).at[parent].add(points)
    return total / jnp.maximum(num, 1)[:, None]


def block_inverses(A: Float[Array, "v k k"]) -> Float[Array, "v k k"]:
    """Inverses of semidefinite blocks, zero where nothing holds."""
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    # A unit diagonal first, so that parts in other units keep their digits.
    root = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    both = root[:, :, None] * root[:, None, :]
    return inverse_semidefinite(A * both) * both


def ridged_inverse(A: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverses of semidefinite matrices whose empty rows are left alone."""
    factor, root = ridged_factor(A)
    eyes = jnp.broadcast_to(jnp.eye(A.shape[-1], dtype=A.dtype), A.shape)
    half = jax.lax.linalg.triangular_solve(factor, eyes, left_side=True, lower=True)
    inverse = jnp.swapaxes(half, -1, -2) @ half
    return inverse * root[..., :, None] * root[..., None, :]


def ridged_factor(
    A: Float[Array, "*b n n"],
) -> tuple[Float[Array, "*b n n"], Float[Array, "*b n"]]:
    """L and s with A close to diag(1 / s) L L' diag(1 / s), for the same matrices."""
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    # A unit diagonal first, so that parts in other units keep their digits.
    root = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    scaled = A * root[..., :, None] * root[..., None, :]
    eye = jnp.eye(A.shape[-1], dtype=A.dtype)
    ridge = jnp.where(diagonal > 0, 30 * jnp.finfo(A.dtype).eps, 1)
    return jnp.linalg.cholesky(scaled + ridge[..., None] * eye), root
