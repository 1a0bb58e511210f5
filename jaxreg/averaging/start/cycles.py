"""Trust in edges from the motions alone: do cycles of three edges close?

If the other two edges of a cycle are right, the product of the motions is near the
identity exactly when the third is right too. Each edge gathers, over all frames k, the
evidence of the cycle i -> k -> j, weighted by the present trust that (i, k) and (k, j)
are both right, for a few rounds. Weighting cycles by their other edges is the idea of
cycle-edge message passing (Lerman and Shi 2021); the evidence here is a ratio of
likelihoods that needs no noise level: if every scale of noise is as likely, the density
of closing errors of right cycles falls as the k-th power of the error, k = 6 or 3.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg.averaging.likelihood import DEVIATIONS, prior_odds
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import DENSE_LIMIT


# The least that a cycle says, for right edges may leave one open: chosen on generated
# graphs.
_LEAST = 0.3
# Edges whose cycles are closed side by side, at most.
_GROUP = 32
#: Rounds of messages among cycles, and of steps that settle chains. Further ones change
#: little: eight find as many frames of the scenes, for half as much time again.
ROUNDS = 5
#: Closing errors, in radians and length scales, that speak neither for nor against:
#: deviations of right edges, from the widest at which few wrong ones close.
NEUTRAL = DEVIATIONS[1:5]


def judged(graph: PoseGraph, max_cycles: int) -> bool:
    """Whether `edge_log_odds` looks at the cycles of a graph.

    If it is small, or of moderate size and has a cycle for each frame: sparser ones
    have hardly any of three edges.
    """
    cycles = graph.num_edges - graph.num_poses + 1
    if cycles < graph.num_poses and graph.num_poses > DENSE_LIMIT:
        return False
    return graph.num_edges * graph.num_poses <= max_cycles


def edge_log_odds(graph: PoseGraph) -> Float[Array, "s e"]:
    """The logarithm of the odds that each edge is right, judged by its 3-cycles.

    One row for each of `NEUTRAL`. Random wrong motions hardly ever close a cycle, even
    roughly; wrong ones that agree with each other close some roughly, but seldom as
    well as right ones. Cycles through a pair of frames with several edges use the
    heaviest of them. A prior weight multiplies the prior odds. Time and memory in
    proportion to edges times frames. -inf for edges of weight 0.

    Gradients: none (cut).
    """
    graph = jax.lax.stop_gradient(graph)
    present = graph.weight > 0
    prior = prior_odds(graph)
    error, closed, via_i, via_j = _cycles(graph)
    # No cycle closes better than the finest noise.
    error = jnp.maximum(error, DEVIATIONS[-1] ** 2)
    power = lie.tangent_dim(graph.dim) / 2

    def at_scale(neutral: Array) -> Array:
        ratio = jnp.maximum((neutral**2 / error) ** power, _LEAST)
        gain = jnp.where(closed, ratio - 1, 0)

        def gather(_: Array, odds: Array) -> Array:
            trust = jnp.append(jax.nn.sigmoid(odds), jnp.zeros((1,), odds.dtype))
            said = jnp.log1p(trust[via_i] * trust[via_j] * gain)
            return prior + jnp.sum(said, axis=1)

        return control.fori_loop(0, ROUNDS, gather, prior)

    odds = jax.vmap(at_scale)(jnp.asarray(NEUTRAL, prior.dtype))
    return jnp.where(present[None], odds, -jnp.inf)


def _cycles(graph: PoseGraph) -> tuple[Array, Array, Array, Array]:
    """Closing error, presence, and edges (i, k), (k, j) of the cycles of each edge.

    All are `(e, v)`; absent edges have number e.
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
    closed = (via_i < absent) & (via_j < absent)
    return error, closed, via_i, via_j


def _closing_errors(graph: PoseGraph, T_a_b: Float[Array, "v v D D"]) -> Array:
    """Squared angle (chordal) plus squared length of T_i_k T_k_j against T_i_j.

    Edges go in groups that a CPU's caches hold, and components one by one: each is a
    plain product of `(group, v)` arrays. (All 2,048 edges of 128 frames at once take
    33 ms, in groups 1.2.)
    """
    d, scale = graph.dim, graph.length_scale
    # Entries (a, b) of the motions T_i_k for all k of each i, and T_k_j of each j.
    out = jnp.transpose(T_a_b[..., :d, :], (0, 2, 3, 1))
    back = jnp.transpose(T_a_b[..., :d, :], (1, 2, 3, 0))

    def of_edge(edge: tuple[Array, Array]) -> Float[Array, " v"]:
        (i, j), C = edge
        A, B = out[i], back[j]
        trace, shift = jnp.zeros((), C.dtype), jnp.zeros((), C.dtype)
        for a in range(d):
            for b in range(d):
                trace = trace + C[a, b] * sum(A[a, c] * B[c, b] for c in range(d))
            t = sum(A[a, c] * B[c, d] for c in range(d)) + A[a, d] - C[a, d]
            shift = shift + t**2
        return jnp.maximum(d - trace, 0) + shift / scale**2

    return control.grouped_map(of_edge, (graph.edges, graph.T_i_j), _GROUP)
