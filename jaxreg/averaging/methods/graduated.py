"""Robust averaging of large graphs: Levenberg-Marquardt under a shrinking kernel.

Every edge counts by its information and by a Gaussian of its whitened error, whose
width is halved from one that sees the right edges in spite of the drift of the start
down to ten deviations of the edges inside it. Closures that no other confirms count
little until the last width, where their error alone decides.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.likelihood import SETTLED, agreed_share, explained
from jaxreg.averaging.measures import (
    length_scale,
    nearest_rank,
    num_held,
    weighted_mean,
)
from jaxreg.averaging.steps.edge_errors import LogError
from jaxreg.averaging.steps.gauss_newton import gauss_newton_gradients, precisions
from jaxreg.averaging.steps.iterate import Iterated, pose_change
from jaxreg.averaging.steps.kernel_width import CHI2_MEDIAN
from jaxreg.averaging.steps.levenberg_marquardt import (
    Minimum,
    Problem,
    minimise,
    no_cycle,
    robust_problem,
)
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.robust import Welsch


# The last width in deviations: right edges lose nothing, and the wrong ones of large
# graphs are far beyond. The first width in deviations, of starts that have spread.
_DEVIATIONS, _FIRST = 10.0, 40.0
_COARSE, _FINE = 1e-3, 1e-6
_ROUNDS = 24
# The next width is the last one where it is no narrower than this share.
_SAME = 0.9
# Wide enough to be none.
_NO_KERNEL = 1e6
# The first width of chained starts: so many times the error at this quantile of the
# edges that do not hold, where lone closures are doubted and where none are.
_SIFTED, _UNSIFTED = (4.0, 0.98), (2.0, 0.25)
# Edges with more trust than this are inside.
_INSIDE = 0.05


class _State(NamedTuple):
    found: Minimum
    parts: Array  # (2,) deviations of a translation and a rotation
    width: Array  # of this minimisation
    next_width: Array
    round: Array
    done: Array
    rows: Array  # of the trace


class _Best(NamedTuple):
    end: _State
    score: Array
    tried: Array
    settled: Array


def graduated(
    graph: PoseGraph,
    near: PoseGraph,
    starts: Float[Array, "s v D D"],
    max_steps: int,
) -> Iterated:
    """The best of the ends from several starts, tried until one leaves few edges out.

    Each start takes rounds of minimisation, at most `max_steps` steps each, under
    narrower and narrower kernels. The last that is tried takes no edge for wrong: from
    the best end without a kernel. `near` is the graph `without_lone_closures`: those
    are wrong as a rule, so they do not count in the wide kernels, and leaving them out
    is no reason to search on.

    Gradients: implicit at the fixed point, widths are cut.
    """
    fixed, near, starts = jax.lax.stop_gradient((graph, near, starts))
    believed = (fixed.weight > 0) & (near.weight == fixed.weight)
    certain = eqx.tree_at(
        lambda g: g.weight, fixed, jnp.where(believed, fixed.weight, 0)
    )
    doubt = near.weight / jnp.where(fixed.weight > 0, fixed.weight, 1)

    def attempt(b: _Best) -> _Best:
        every = b.tried == starts.shape[0]
        T_start = jnp.where(every, b.end.found.T, starts[b.tried])
        end = _narrowed(fixed, doubt, T_start, every, max_steps)
        score = explained(fixed, end.found.T).log_ratio
        steps = b.end.found.step + end.found.step
        better = score > b.score
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), end, b.end)
        best = best._replace(found=best.found._replace(step=steps))
        return _Best(
            best,
            jnp.maximum(score, b.score),
            b.tried + 1,
            agreed_share(certain, end.found.T) > SETTLED,
        )

    begin = _Best(
        _before(fixed, doubt, starts[0], jnp.asarray(False)),
        -jnp.full((), jnp.inf, starts.dtype),
        jnp.asarray(0, jnp.int32),
        jnp.asarray(False),
    )
    end = jax.lax.while_loop(
        lambda b: (b.tried <= starts.shape[0]) & ~b.settled, attempt, begin
    ).end
    result = Iterated(
        end.found.T,
        _trust_at(end, fixed, end.found.T),
        _DEVIATIONS * end.parts,
        end.found.converged,
        end.found.step,
        AveragingTrace.of(end.rows, end.round),
    )
    return gauss_newton_gradients(graph, result, eqx.Partial(_trust_at, end))


def _trust_at(state: _State, graph: PoseGraph, T: Array, _: object = None) -> Array:
    """Of each edge at the widths of a state."""
    now = _problem(graph, state.parts, state.width)
    return now.trust(now.squares(T))


def _problem(
    graph: PoseGraph, parts: Array, width: Array, doubt: Array | float = 1.0
) -> Problem:
    W = precisions(graph, jnp.ones_like(graph.weight), parts)
    full = robust_problem(graph, LogError(), W, Welsch(), width)
    return full._replace(
        loss=lambda s: doubt * full.loss(s), trust=lambda s: doubt * full.trust(s)
    )


def _before(graph: PoseGraph, doubt: Array, T_start: Array, every: Array) -> _State:
    """Nothing minimised yet; the first width is the last if every edge is to count."""
    parts = _parts(graph, T_start, jnp.ones_like(graph.weight))
    squares = _problem(graph, parts, jnp.ones_like(parts[0])).squares(T_start)
    width = _first_width(graph, doubt == 1, T_start, squares)
    width = jnp.where(every, _NO_KERNEL, width)
    none = jnp.asarray(0, jnp.int32)
    cycle = no_cycle(_problem(graph, parts, width), T_start)
    start = Minimum(T_start, jnp.asarray(False), none, cycle, None)
    before = jnp.where(every, width, jnp.inf)
    rows, no = no_rows(_ROUNDS + 1, T_start.dtype), jnp.asarray(False)
    return _State(start, parts, before, width, none, no, rows)


def _narrowed(
    graph: PoseGraph, doubt: Array, T_start: Array, every: Array, max_steps: int
) -> _State:
    """Minimises under narrower kernels until the edges inside fill the kernel.

    Then once more with all edges, to the end; at once and without a kernel if `every`
    edge is to count.
    """

    def turn(s: _State) -> _State:
        last = (s.next_width > _SAME * s.width) | (s.round == _ROUNDS)
        now = _problem(graph, s.parts, s.next_width, jnp.where(last, 1, doubt))
        least = jnp.where(last, _FINE, _COARSE)
        new = minimise(now, s.found.T, max_steps, least, s.found.cycle)
        squares = now.squares(new.T)
        trust = now.trust(squares)
        deviation = _inside_deviation(graph, squares, trust, s.next_width)
        width = jnp.clip(_DEVIATIONS * deviation, 0.5 * s.next_width, s.next_width)
        width = jnp.maximum(width, 64 * jnp.finfo(width.dtype).eps)
        new = new._replace(step=s.found.step + new.step, trace=None)
        row = (
            pose_change(s.found.T, new.T, scale),
            s.next_width * s.parts,
            weighted_mean(trust, graph.weight),
        )
        rows = with_row(s.rows, s.round, *row)
        parts = jnp.where(last, s.parts, _parts(graph, new.T, trust))
        return _State(new, parts, s.next_width, width, s.round + 1, last, rows)

    scale = length_scale(graph)
    start = _before(graph, doubt, T_start, every)
    return jax.lax.while_loop(lambda s: ~s.done, turn, start)


def _first_width(graph: PoseGraph, believed: Array, T: Array, squares: Array) -> Array:
    """A width that sees the right edges from the start.

    Starts that have spread their drift show the deviation by their middle edge. One
    chained along a tree leaves nothing at the edges of its tree and drift at the right
    ones of the others: twice the lower quartile of those is wide enough. Where lone
    closures are doubted, nearly all others are right, and most of the drift may be at
    a few of them.
    """
    present = (graph.weight > 0) & believed
    open_edges = _open_edges(graph, T) & believed
    chained = jnp.sum(present & ~open_edges) > 0.5 * (num_held(graph) - 1)
    middle = nearest_rank(squares, present, 0.5)
    middle = middle / CHI2_MEDIAN[lie.tangent_dim(graph.dim)]
    spread = _FIRST * jnp.sqrt(middle * _spare(graph))
    doubted = jnp.any((graph.weight > 0) & ~believed)
    sifted, unsifted = jnp.asarray([_SIFTED, _UNSIFTED], squares.dtype)
    times, right = jnp.where(doubted, sifted, unsifted)
    drift = times * jnp.sqrt(nearest_rank(squares, open_edges, right))
    floor = 64 * jnp.finfo(squares.dtype).eps
    return jnp.maximum(jnp.where(chained, drift, spread), floor)


def _open_edges(graph: PoseGraph, T: Array) -> Array:
    """Edges that do not hold exactly."""
    rotation, translation = graph.differences(T)
    sq = rotation / 2 + translation / length_scale(graph) ** 2
    eps = 1e-4 if sq.dtype == jnp.float32 else 1e-8
    return (graph.weight > 0) & (sq > eps**2)


def _inside_deviation(
    graph: PoseGraph, squares: Array, trust: Array, width: Array
) -> Array:
    """Of one whitened component, by the mean of the edges inside a kernel.

    As in `annealed_width`: the kernel's own narrowing of the mean is undone.
    """
    w = jnp.where(graph.weight > 0, trust, 0)
    total = jnp.maximum(jnp.sum(w), jnp.finfo(w.dtype).tiny)
    mean = jnp.sum(w * squares) / total / lie.tangent_dim(graph.dim)
    ratio = jnp.minimum(mean / width**2, 0.9)
    return jnp.sqrt(ratio / (1 - ratio) * _spare(graph)) * width


def _parts(graph: PoseGraph, T: Array, trust: Array) -> Float[Array, "2"]:
    """Of one component of the translation and of the rotation, by the middle edges.

    Among those inside the kernel that do not hold exactly.
    """
    rotation, translation = graph.differences(T)
    d, present = graph.dim, _open_edges(graph, T) & (trust > _INSIDE)
    dof = lie.tangent_dim(d) - d
    middle = jnp.stack(
        [
            nearest_rank(translation, present, 0.5) / CHI2_MEDIAN[d],
            nearest_rank(rotation, present, 0.5) / (2 * CHI2_MEDIAN[dof]),
        ]
    )
    floor = 64 * jnp.finfo(middle.dtype).eps
    floor = floor * jnp.stack([length_scale(graph), jnp.ones_like(middle[1])])
    return jnp.maximum(jnp.sqrt(middle * _spare(graph)), floor)


def _spare(graph: PoseGraph) -> Array:
    """Edges over those that the poses do not use up, at most 4."""
    count = jnp.sum(graph.weight > 0).astype(graph.weight.dtype)
    spare = jnp.maximum(count - (num_held(graph) - 1), 0.25 * count)
    return count / jnp.maximum(spare, 1)
