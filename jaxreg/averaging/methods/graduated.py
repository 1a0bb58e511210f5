"""Robust averaging of large graphs: Levenberg-Marquardt under a shrinking kernel.

Every edge counts by its information and by a Gaussian of its whitened error, whose
width is halved from one that sees the right edges in spite of the drift of the start
down to ten deviations of the edges inside it. Closures that drift does not explain, or
that no other confirms, count little until the last width, where their error alone
decides.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.loop import AbstractIteration, iterate
from jaxreg._core.quantile import nearest_rank
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.likelihood import SETTLED, Likelihood, squared_errors
from jaxreg.averaging.measures import weighted_mean
from jaxreg.averaging.steps.edge_errors import LogError
from jaxreg.averaging.steps.edge_problem import Problem, robust_problem
from jaxreg.averaging.steps.gauss_newton import precisions
from jaxreg.averaging.steps.gradients import gauss_newton_gradients
from jaxreg.averaging.steps.iterate import Iterated, pose_change
from jaxreg.averaging.steps.kernel_width import (
    chi2_median,
    middle_variances,
    spare_factor,
    spared_variances,
    variance_inside,
)
from jaxreg.averaging.steps.levenberg_marquardt import Minimum, minimise, no_cycle
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.robust import Welsch


# The last width in deviations: right edges lose nothing, and the wrong ones of large
# graphs are far beyond.
_DEVIATIONS = 10.0
# The first width, over the last one or over the drift that a start shows: two octaves.
# Public graphs with false closures and grids of up to 10,000 poses trust none of them.
_WIDER = 4.0
# Share of the objective that the last minimisation may leave, as in `PoseGraphLM`;
# those before, its root: wide kernels only find the way.
_LEFT = 1e-6


def graduated(
    graph: PoseGraph,
    likelihood: Likelihood,
    near: PoseGraph,
    starts: Float[Array, "s v D D"],
    max_steps: int,
) -> Iterated:
    """The best of the ends from several starts, tried until one leaves few edges out.

    Each start takes rounds of minimisation, at most `max_steps` steps each, under
    narrower and narrower kernels. The last that is tried takes no edge for wrong: from
    the best end without a kernel. `near` is the graph `without_doubtful_closures`:
    those are wrong as a rule, so they do not count in the wide kernels, and leaving
    them out is no reason to search on.

    Gradients: implicit at the fixed point, widths are cut.
    """
    fixed = likelihood.graph
    near, starts = jax.lax.stop_gradient((near, starts))
    counted = near.weight / jnp.where(fixed.weight > 0, fixed.weight, 1)
    attempts = _Attempts(_Narrowing(likelihood, counted, max_steps), starts)
    begin = attempts.init(starts[0])
    end = iterate(attempts, begin, max_steps=len(starts) + 1).state.end
    trust_of = eqx.Partial(kernel_trust, end.parts, end.width)
    result = Iterated(
        end.found.T,
        trust_of(fixed, end.found.T),
        reported_width(end.parts),
        end.found.converged,
        end.found.step,
        AveragingTrace.of(end.rows, end.num_steps),
    )
    return gauss_newton_gradients(graph, result, trust_of)


def reported_width(parts: Float[Array, "2"]) -> Float[Array, "2"]:
    """That of a solution, from the deviations of a translation and a rotation."""
    return _DEVIATIONS * parts


def last_kernel(found: AveragingSolution) -> tuple[np.ndarray, np.ndarray]:
    """The deviations of both parts, and the width over them, that a solution ended by.

    Args:
        found: of `Correntropy` on a graph of more than `DENSE_LIMIT` frames, concrete.
    """
    assert found.trace is not None
    parts = np.asarray(found.kernel_width) / _DEVIATIONS
    last = np.asarray(found.trace.kernel_width)[int(found.trace.num_rows) - 1]
    return parts, np.asarray(last[1] / parts[1])


def kernel_trust(
    parts: Array, width: Array, graph: PoseGraph, T: Array, _: object = None
) -> Float[Array, " e"]:
    """Of each edge under a kernel."""
    now = _problem(graph, parts, width)
    return now.trust(now.squares(T))


def _problem(
    graph: PoseGraph, parts: Array, width: Array, counted: Array | float = 1.0
) -> Problem:
    W = precisions(graph, jnp.ones_like(graph.weight), parts)
    full = robust_problem(graph, LogError(), W, Welsch(), width)
    return full._replace(
        loss=lambda s: counted * full.loss(s),
        trust=lambda s: counted * full.trust(s),
    )


class _State(NamedTuple):
    found: Minimum
    parts: Array  # (2,) deviations of a translation and a rotation
    width: Array  # of this minimisation
    next_width: Array
    num_steps: Int[Array, ""]  # widths
    done: Bool[Array, ""]
    rows: Array  # of the trace


class _Narrowing(AbstractIteration[tuple[Array, Array], _State]):
    """Minimises under narrower kernels until the edges inside fill the kernel.

    Then once more with all edges, to the end; at once and without a kernel if every
    edge is to count. `counted` is the
    share that edges have before the end.
    """

    likelihood: Likelihood
    counted: Float[Array, " e"]
    max_steps: int  # of a minimisation

    @property
    def graph(self) -> PoseGraph:
        """The motions."""
        return self.likelihood.graph

    @property
    def most(self) -> int:
        """Widths at most: as many as a float has halvings, and the last."""
        return int(jnp.finfo(self.counted.dtype).nmant) + 1

    @property
    def trusted(self) -> Bool[Array, " e"]:
        """Edges that count fully."""
        return (self.graph.weight > 0) & (self.counted == 1)

    def init(self, start: tuple[Array, Array]) -> _State:
        """Nothing minimised yet, from poses, and whether every edge is to count."""
        T, every = start
        graph, one = self.graph, jnp.ones_like(self.counted)
        parts = self._parts(T, one)
        width = self._first_width(T, _problem(graph, parts, one[0]).squares(T))
        # Wide enough to be none, and its square is finite.
        width = jnp.where(every, jnp.finfo(width.dtype).max ** 0.25, width)
        none, no = jnp.asarray(0, jnp.int32), jnp.asarray(False)
        cycle = no_cycle(_problem(graph, parts, width), T)
        return _State(
            found=Minimum(T, no, none, cycle, None),
            parts=parts,
            width=jnp.where(every, width, jnp.inf),
            next_width=width,
            num_steps=none,
            done=no,
            rows=no_rows(self.most, T.dtype),
        )

    def terminate(self, state: _State) -> Bool[Array, ""]:
        return state.done

    def fail(self, state: _State) -> Bool[Array, ""]:
        return jnp.isnan(state.next_width)

    def step(self, state: _State) -> _State:
        """The minimum under the next width; the last is one that need not halve."""
        s, graph, width = state, self.graph, state.next_width
        last = (width > s.width / 2) | (s.num_steps == self.most - 1)
        now = _problem(graph, s.parts, width, jnp.where(last, 1, self.counted))
        least = jnp.where(last, _LEFT, _LEFT**0.5)
        new = minimise(now, s.found.T, self.max_steps, least, s.found.cycle)
        squares = now.squares(new.T)
        trust = now.trust(squares)
        change = pose_change(graph, self.likelihood.scale, s.found.T, new.T)
        trusted = weighted_mean(trust, graph.weight)
        wanted = _DEVIATIONS * self._deviation(squares, trust, width)
        next_width = jnp.clip(wanted, width / 2, width)
        return _State(
            found=new._replace(step=s.found.step + new.step, trace=None),
            parts=jnp.where(last, s.parts, self._parts(new.T, trust)),
            width=width,
            next_width=jnp.maximum(next_width, 64 * jnp.finfo(width.dtype).eps),
            num_steps=s.num_steps + 1,
            done=last,
            rows=with_row(s.rows, s.num_steps, change, width * s.parts, trusted),
        )

    def _first_width(self, T: Array, squares: Array) -> Float[Array, ""]:
        """A width that sees the right edges from the start.

        Starts that have spread their drift show the deviation by their middle edge. One
        chained along a tree leaves nothing at the edges of its tree and drift at the
        right ones of the others, at least a quarter. Where lone closures are doubted,
        nearly all others are right, and most of the drift may be at a few of them.
        """
        graph, present = self.graph, self.trusted
        open_edges = self._open(T) & present
        chained = jnp.sum(present & ~open_edges) > 0.5 * (graph.num_held - 1)
        middle = nearest_rank(squares, present, 0.5) * self._spare_factor(present)
        middle = middle / chi2_median(lie.tangent_dim(graph.dim))
        doubted = jnp.any((graph.weight > 0) & ~present)
        drift = nearest_rank(squares, open_edges, jnp.where(doubted, SETTLED, 0.25))
        usual = jnp.where(chained, drift, _DEVIATIONS**2 * middle)
        floor = 64 * jnp.finfo(squares.dtype).eps
        return jnp.maximum(_WIDER * jnp.sqrt(usual), floor)

    def _open(self, T: Array) -> Bool[Array, " e"]:
        """Edges that do not hold exactly."""
        scale = self.likelihood.scale
        sq = squared_errors(self.graph, self.graph.predicted(T), scale)
        eps = 1e-4 if sq.dtype == jnp.float32 else 1e-8
        return (self.graph.weight > 0) & (sq > eps**2)

    def _deviation(self, squares: Array, trust: Array, width: Array) -> Array:
        """Of one whitened component, by the mean of the edges inside a kernel."""
        w = jnp.where(self.graph.weight > 0, trust, 0)
        total = jnp.maximum(jnp.sum(w), jnp.finfo(w.dtype).tiny)
        mean = jnp.sum(w * squares) / total / lie.tangent_dim(self.graph.dim)
        return jnp.sqrt(variance_inside(mean, width) * self._spare_factor(trust))

    def _parts(self, T: Array, trust: Array) -> Float[Array, "2"]:
        """Of one component of the translation and of the rotation, by the middle edges.

        Among those inside the kernel that do not hold exactly.
        """
        of, graph = self._open(T) & (trust > 0.5), self.graph
        middle = middle_variances(graph.differences(T), of, graph.dim)
        floor = 64 * jnp.finfo(middle.dtype).eps
        count, scale = self._count(trust), self.likelihood.scale
        floor = floor * jnp.stack([scale, jnp.ones_like(scale)])
        variance = spared_variances(graph, middle, count, scale)
        return jnp.maximum(jnp.sqrt(variance), floor)

    def _spare_factor(self, trust: Array) -> Float[Array, ""]:
        """How much more noise there is than the poses leave, by the edges inside."""
        return spare_factor(self.graph, self._count(trust))

    def _count(self, trust: Array) -> Float[Array, ""]:
        """How many edges are inside."""
        trust = jnp.where(self.graph.weight > 0, trust, 0)
        return jnp.sum(trust, dtype=self.counted.dtype)


def _without_cycle(state: _State) -> _State:
    """Multigrid cycles are as large as the graph, and each attempt builds its own."""
    return state._replace(found=state.found._replace(cycle=None))


class _Best(NamedTuple):
    end: _State  # without its cycle
    score: Array
    num_steps: Int[Array, ""]  # starts that were tried
    settled: Bool[Array, ""]


class _Attempts(AbstractIteration[Array, _Best]):
    """The likeliest end from the starts, and from it with every edge."""

    narrowing: _Narrowing
    starts: Float[Array, "s v D D"]

    def init(self, start: Array) -> _Best:
        no = jnp.asarray(False)
        return _Best(
            end=_without_cycle(self.narrowing.init((start, no))),
            score=-jnp.full((), jnp.inf, start.dtype),
            num_steps=jnp.asarray(0, jnp.int32),
            settled=no,
        )

    def terminate(self, state: _Best) -> Bool[Array, ""]:
        return state.settled

    def fail(self, state: _Best) -> Bool[Array, ""]:
        return jnp.asarray(False)

    def step(self, state: _Best) -> _Best:
        b, narrowing = state, self.narrowing
        graph = narrowing.graph
        every = b.num_steps == len(self.starts)
        T_start = jnp.where(every, b.end.found.T, self.starts[b.num_steps])
        begin = narrowing.init((T_start, every))
        end = iterate(narrowing, begin, max_steps=narrowing.most).state
        end = _without_cycle(end)
        score = narrowing.likelihood.explained(end.found.T).log_ratio
        steps = b.end.found.step + end.found.step
        better = score > b.score
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), end, b.end)
        trusted = jnp.where(narrowing.trusted, graph.weight, 0)
        among = Likelihood.of(eqx.tree_at(lambda g: g.weight, graph, trusted))
        return _Best(
            end=best._replace(found=best.found._replace(step=steps)),
            score=jnp.maximum(score, b.score),
            num_steps=b.num_steps + 1,
            settled=among.agreed_share(among.explained(end.found.T)) > SETTLED,
        )
