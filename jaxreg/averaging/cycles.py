"""Belief in edges from the motions alone: do cycles of three edges close?

If the other two edges of a cycle are right, the product of the motions is near the
identity exactly when the third is right too. Each edge gathers, over all frames k, the
evidence of the cycle i -> k -> j, weighted by the present belief that (i, k) and (k, j)
are both right, for a few rounds. Weighting cycles by their other edges is the idea of
cycle-edge message passing (Lerman and Shi 2021); the evidence here is a ratio of
likelihoods that needs no noise level: the density of closing errors of right cycles is
taken to fall as a power of the error, as it does if every scale of noise is as likely.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.base import length_scale
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


#: Cycles are tried for at most this many edges times frames.
CYCLE_LIMIT = 1_000_000
# Chosen on synthetic graphs, where results hardly depend on them: the share of right
# edges, the closing error that speaks neither for nor against, the power of the
# density, the largest ratio, and the rounds.
_PRIOR, _NEUTRAL, _POWER, _CAP, _ROUNDS = 0.4, 0.3, 4, 1e4, 6


def judged(graph: PoseGraph) -> bool:
    """Whether the graph is small enough for `edge_log_odds` to look at its cycles."""
    return graph.num_edges * graph.num_poses <= CYCLE_LIMIT


def edge_log_odds(graph: PoseGraph) -> Float[Array, " e"]:
    """The logarithm of the odds that each edge is right, judged by its 3-cycles.

    Cycles through a pair of frames with several edges use the heaviest of them. A
    prior weight multiplies the prior odds. Graphs with more edges times frames than
    `CYCLE_LIMIT` are not judged: their edges keep the prior odds. -inf for edges of
    weight 0.

    Gradients: none (cut).
    """
    graph = jax.lax.stop_gradient(graph)
    present = graph.weight > 0
    usual = jnp.sum(graph.weight) / jnp.maximum(jnp.sum(present), 1)
    relative = jnp.where(present, graph.weight / jnp.where(usual > 0, usual, 1), 1)
    prior = jnp.log(relative * (_PRIOR / (1 - _PRIOR)))
    if not judged(graph):
        return jnp.where(present, prior, -jnp.inf)
    ratio, via_i, via_j = _cycles(graph)

    def gather(_: Array, odds: Array) -> Array:
        belief = jnp.append(jax.nn.sigmoid(odds), jnp.zeros((1,), odds.dtype))
        both = belief[via_i] * belief[via_j]
        return prior + jnp.sum(jnp.log1p(both * (ratio - 1)), axis=1)

    odds = jax.lax.fori_loop(0, _ROUNDS, gather, prior)
    return jnp.where(present, odds, -jnp.inf)


def _cycles(graph: PoseGraph) -> tuple[Array, Array, Array]:
    """Likelihood ratio and edges (i, k), (k, j) of the cycles of each edge.

    All are `(e, v)`; absent edges have number e and their cycles ratio 1.
    """
    num, num_edges = graph.num_poses, graph.num_edges
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    absent = num_edges
    top = jnp.zeros((num, num), graph.weight.dtype)
    top = top.at[i, j].max(graph.weight).at[j, i].max(graph.weight)
    order = jnp.arange(num_edges, dtype=jnp.int32)
    order = jnp.where((graph.weight > 0) & (graph.weight == top[i, j]), order, absent)
    table = jnp.full((num, num), absent, jnp.int32).at[i, j].min(order)
    table = table.at[j, i].min(order)
    last = jnp.eye(graph.dim + 1, dtype=graph.T_i_j.dtype)[None]
    T = jnp.concatenate([graph.T_i_j, last])
    forward = jnp.append(i, -1)[table] == jnp.arange(num)[:, None]
    T_a_b = jnp.where(forward[..., None, None], T[table], lie.inverse(T)[table])
    via_i, via_j = table[i], table[j]
    error = _closing_errors(graph, T_a_b)
    ratio = jnp.minimum((_NEUTRAL**2 / error) ** (_POWER / 2), _CAP)
    closed = (via_i < absent) & (via_j < absent)
    return jnp.where(closed, ratio, 1), via_i, via_j


def _closing_errors(graph: PoseGraph, T_a_b: Array) -> Array:
    """Squared angle (chordal) plus squared length of T_i_k T_k_j against T_i_j.

    Sums over components one by one: each is a plain product of `(e, v)` arrays.
    """
    d = graph.dim
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    # Components first: A[a][b] is the entry (a, b) of T_i_k, B of T_k_j.
    parts = jnp.moveaxis(T_a_b, (-2, -1), (0, 1))
    A, B = parts[:, :, i, :], jnp.swapaxes(parts, 2, 3)[:, :, j, :]
    C = jnp.moveaxis(graph.T_i_j, 0, -1)[..., None]
    trace = jnp.zeros((), graph.T_i_j.dtype)
    shift = jnp.zeros((), graph.T_i_j.dtype)
    for a in range(d):
        for b in range(d):
            trace = trace + C[a, b] * sum(A[a, c] * B[c, b] for c in range(d))
        t = sum(A[a, c] * B[c, d] for c in range(d)) + A[a, d] - C[a, d]
        shift = shift + t**2
    floor = 64 * jnp.finfo(graph.T_i_j.dtype).eps
    return jnp.maximum(d - trace, 0) + shift / length_scale(graph) ** 2 + floor
