"""Poses from a low-rank plus sparse split of all relative motions (LRS of the paper).

The matrix of blocks T_i_j = inv(T_world_i) T_world_j is the product of a (4 v, 4) and a
(4, 4 v) matrix. Absent blocks and wrong ones are split off.

Reference: Arrigoni, Rossi, Fusiello 2016 (R-GoDec); block-wise shrinkage as in their
paper on SE(3) of 2018.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_positive
from jaxreg._core.loop import AbstractIteration, iterate
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key, Scalar
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    of_start,
    solution,
)
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import DENSE_LIMIT


class LowRankSparse(AbstractAverager):
    """The LRS initialiser: needs many edges, bears some wrong ones.

    Minimises |X - L - S1 - S2|_F^2 / 2 + threshold * sum of |S1 block|_F with L of rank
    d + 1, S1 on the observed blocks and S2 on the absent ones, where X is 0, in turns.
    Poses are the first block column of L, projected onto SE(d). The matrix is dense:
    for at most `DENSE_LIMIT` frames. `init` is ignored; prior weights only say which
    edges are there and average several edges of a pair.

    Attributes:
        threshold: blocks further than this (Frobenius norm, lengths in the length
            scale of the graph) from L count as wrong and pull with this force alone.
        max_steps: largest number of turns (static).
        tolerance: stop when L changes by less than this share.

    Raises:
        ValueError: for more than `DENSE_LIMIT` frames.

    `edge_weight` is threshold / distance of the block from L, at most 1.

    Gradients: none; asking for them raises a TypeError.
    """

    threshold: Array | float = traced(0.05)
    max_steps: int = eqx.field(static=True, default=1000)
    tolerance: Array | float = traced(1e-5)

    def __check_init__(self) -> None:
        """Refuses counts and numbers that leave nothing to do."""
        check_counts(self, max_steps=1)
        check_positive(self, "threshold")
        check_not_negative(self, "tolerance")

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Splits the matrix of a prepared graph."""
        num, D = graph.num_poses, graph.dim + 1
        if num > DENSE_LIMIT:
            raise ValueError(
                f"LowRankSparse: wanted at most {DENSE_LIMIT} poses, found {num}; "
                "use SpanningTree or CycleConsensus."
            )
        held, method = jax.lax.stop_gradient((graph, self))
        scale = held.length_scale
        X, seen = _blocks(held, scale)
        limit = jnp.maximum(method.tolerance, 8 * jnp.finfo(X.dtype).eps)
        splitting = _Splitting(X, seen, jnp.asarray(method.threshold), limit)
        eye = jnp.tile(jnp.eye(D, dtype=X.dtype), (num, 1))
        ended = iterate(splitting, splitting.init(eye), max_steps=method.max_steps)
        end = ended.state
        distance = _block_norms(X - end.L, num)[held.edges[:, 0], held.edges[:, 1]]
        found = solution(
            held,
            _poses(end.L, num, scale),
            edge_weight=method.threshold / jnp.maximum(distance, method.threshold),
            converged=ended.converged,
            num_steps=end.num_steps,
        )
        return of_start(self, graph, found)


class _State(NamedTuple):
    basis: Float[Array, "n D"]  # spans the columns of L
    L: Float[Array, "n n"]
    change: Float[Array, ""]
    num_steps: Int[Array, ""]


class _Splitting(AbstractIteration[Array, _State]):
    """S1, S2 and L in turns, from a basis of the columns of L."""

    X: Float[Array, "n n"]
    seen: Bool[Array, "v v"]
    threshold: Scalar
    limit: Scalar

    def init(self, start: Array) -> _State:
        return _State(
            basis=start,
            L=jnp.zeros_like(self.X),
            change=jnp.asarray(jnp.inf, start.dtype),
            num_steps=jnp.asarray(0, jnp.int32),
        )

    def terminate(self, state: _State) -> Bool[Array, ""]:
        return state.change <= self.limit

    def fail(self, state: _State) -> Bool[Array, ""]:
        return jnp.isnan(state.change)

    def step(self, state: _State) -> _State:
        """S1 and S2 for the present L, then L by one step of subspace iteration."""
        num = self.seen.shape[0]
        D = self.X.shape[0] // num
        gap = self.X - state.L
        norm = _block_norms(gap, num)
        kept = jnp.minimum(self.threshold / jnp.where(norm > 0, norm, 1), 1)
        # X - S1 - S2 is L plus the share of the gap that is not split off.
        share = jnp.repeat(jnp.repeat(jnp.where(self.seen, kept, 0), D, 0), D, 1)
        rest = state.L + share * gap
        basis = jnp.linalg.qr(rest @ (rest.T @ state.basis))[0]
        L = basis @ (basis.T @ rest)
        size = jnp.sqrt(jnp.sum(L**2))
        change = jnp.sqrt(jnp.sum((L - state.L) ** 2)) / jnp.where(size > 0, size, 1)
        return _State(basis, L, change, state.num_steps + 1)


def _block_norms(A: Array, num: int) -> Float[Array, "v v"]:
    D = A.shape[0] // num
    return jnp.sqrt(jnp.sum(A.reshape(num, D, num, D) ** 2, axis=(1, 3)))


def _blocks(
    graph: PoseGraph, scale: Array
) -> tuple[Float[Array, "n n"], Bool[Array, "v v"]]:
    """The matrix of observed motions, lengths over `scale`, and where it has blocks."""
    num, D = graph.num_poses, graph.dim + 1
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    T = lie.compose(lie.rotation(graph.T_i_j), lie.translation(graph.T_i_j) / scale)
    w = graph.weight[:, None, None]
    total = jnp.zeros((num, num), w.dtype)
    total = total.at[i, j].add(graph.weight).at[j, i].add(graph.weight)
    X = jnp.zeros((num, num, D, D), w.dtype)
    X = X.at[i, j].add(w * T).at[j, i].add(w * lie.inverse(T))
    X = X / jnp.where(total > 0, total, 1)[..., None, None]
    own, held = jnp.arange(num), jnp.any(total > 0, axis=1)
    eye = jnp.where(held[:, None, None], jnp.eye(D, dtype=w.dtype)[None], 0)
    X = X.at[own, own].set(eye)
    seen = (total > 0).at[own, own].set(held)
    return X.transpose(0, 2, 1, 3).reshape(num * D, num * D), seen


def _poses(L: Array, num: int, scale: Array) -> Float[Array, "v D D"]:
    """The first block column, which holds T_i_0, as poses T_0_i."""
    D = L.shape[0] // num
    column = L[:, :D].reshape(num, D, D)
    eye = jnp.eye(D, dtype=L.dtype)
    known = jnp.linalg.norm(column[0] - eye) < 0.9  # else it may be singular
    column = column @ jnp.where(known, jnp.linalg.inv(column[0]), eye)
    T_i_0 = lie.compose(column[:, :-1, :-1], scale * column[:, :-1, -1])
    T_i_0 = lie.orthonormalise(T_i_0)
    return lie.inverse(T_i_0).at[0].set(eye)
