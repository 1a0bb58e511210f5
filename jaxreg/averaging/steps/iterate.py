"""The loop of motion averaging: kernel width, trust, one solve, updated poses."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import loop
from jaxreg._core.typing import Scalar
from jaxreg.averaging.base import AveragingSolution, solution
from jaxreg.averaging.likelihood import Likelihood
from jaxreg.averaging.measures import weighted_mean
from jaxreg.averaging.steps.rows import AbstractRows
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import solve_flow
from jaxreg.linear.small import product


#: Relative tolerance of a step's system: each step takes up what the last one left. On
#: sphere2500 motion averaging ends in five steps where the objective is as at 1e-4.
STEP_TOLERANCE = 1e-2
#: A width that changes by less than this share stands still.
STILL = 1e-3
#: Kernel widths `(2,)` (length, radians) at given poses, from the widths before.
WidthOf = Callable[[PoseGraph, Array, Array], Array]
#: Trust of each edge `(e,)` at given poses and widths.
TrustOf = Callable[[PoseGraph, Array, Array], Array]
#: New poses from poses, trust and widths.
Step = Callable[[PoseGraph, Array, Array, Array], Array]


def held_width(graph: PoseGraph, T: Array, width: Array) -> Array:
    """The width as it is, without derivatives."""
    return width


class Iterated(NamedTuple):
    """Where the loop stopped."""

    T_world_i: Float[Array, "v D D"]
    trust: Float[Array, " e"]
    width: Float[Array, "2"]
    converged: Bool[Array, ""]
    num_steps: Int[Array, ""]
    trace: AveragingTrace


def going_on(first: Iterated, then: Iterated) -> Iterated:
    """The second end, with the steps of both, as far as there is room for them."""
    num, room = first.num_steps, len(first.trace.change)

    def both(a: Array, b: Array) -> Array:
        at = jnp.arange(room) - num
        later = (at >= 0).reshape(-1, *[1] * (a.ndim - 1))
        return jnp.where(later, b[jnp.maximum(at, 0)], a)

    num_steps = jnp.minimum(num + then.num_steps, room)
    one, two = first.trace, then.trace
    trace = AveragingTrace(
        num_steps,
        both(one.change, two.change),
        both(one.kernel_width, two.kernel_width),
        both(one.trust, two.trust),
    )
    return then._replace(num_steps=num_steps, trace=trace)


def solution_of(
    graph: PoseGraph,
    end: Iterated,
    likelihood: Likelihood | None = None,
    evidence: Scalar | None = None,
) -> AveragingSolution:
    """The solution where the loop stopped; its `log_evidence` if that is known."""
    return solution(
        graph,
        end.T_world_i,
        likelihood=likelihood,
        evidence=evidence,
        edge_weight=end.trust,
        converged=end.converged,
        kernel_width=end.width,
        num_steps=end.num_steps,
        trace=end.trace,
    )


def averaging_step(rows: AbstractRows) -> Step:
    """One weighted step of motion averaging (Eq. 14-20), updated on the left.

    T_world_i <- exp(dm_i) T_world_i: Eq. 21 with the update on the side that Eq. 14
    asks for. As printed, on the right, the iteration diverges.
    """

    def step(graph: PoseGraph, T: Array, trust: Array, width: Array) -> Array:
        weight, num = rows.squared(graph, trust), graph.num_poses

        def solve(flow: Array) -> Array:
            return solve_flow(graph.edges, weight, flow, num, STEP_TOLERANCE)

        return averaged(graph, T, solve)

    return step


def averaged(
    graph: PoseGraph, T: Float[Array, "v D D"], solve: Callable[[Array], Array]
) -> Float[Array, "v D D"]:
    """The poses after one step; `solve` finds tangents from logarithms (Eq. 20)."""
    tangent = solve(lie.log(graph.residual_motions(T)))
    return lie.straightened(product(lie.exp(tangent), T))


def iterate(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    width_start: Float[Array, "2"],
    width_of: WidthOf,
    trust_of: TrustOf,
    step_of: Step,
    *,
    max_steps: int,
    tolerance: Array | float,
    at_most: Int[Array, ""] | None = None,
) -> Iterated:
    """Alternates weights and steps until widths and poses stand still.

    Stops when no rotation moves by more than `tolerance` radians, no position by more
    than `tolerance` of the size of the scene, and no width shrinks by more than
    a thousandth of itself, or after `max_steps` or as few as `at_most`. Nothing is
    differentiable here; the caller attaches the derivatives of the fixed point.
    """
    graph, T_start, width_start, tolerance = jax.lax.stop_gradient(
        (graph, T_start, width_start, tolerance)
    )
    limit = jnp.maximum(tolerance, 32 * jnp.finfo(T_start.dtype).eps)
    averaging = _Averaging(
        graph,
        graph.length_scale,
        limit,
        width_of,
        trust_of,
        step_of,
        max_steps,
        jnp.asarray(max_steps if at_most is None else at_most),
    )
    begin = averaging.init((T_start, width_start))
    ended = loop.iterate(averaging, begin, max_steps=max_steps)
    end = ended.state
    trust = trust_of(graph, end.T, end.width)
    trace = AveragingTrace.of(end.rows, end.num_steps)
    return Iterated(end.T, trust, end.width, ended.converged, end.num_steps, trace)


class _State(NamedTuple):
    T: Float[Array, "v D D"]
    width: Float[Array, "2"]
    change: Float[Array, ""]
    num_steps: Int[Array, ""]
    rows: Float[Array, "s 4"]  # of the trace


class _Averaging(loop.AbstractIteration[tuple[Array, Array], _State]):
    """Weights and steps in turns, from poses and kernel widths."""

    graph: PoseGraph
    scale: Scalar
    limit: Scalar
    width_of: WidthOf
    trust_of: TrustOf
    step_of: Step
    max_steps: int
    at_most: Int[Array, ""]

    def init(self, start: tuple[Array, Array]) -> _State:
        T, width = start
        return _State(
            T=T,
            width=width,
            change=jnp.asarray(jnp.inf, T.dtype),
            num_steps=jnp.asarray(0, jnp.int32),
            rows=no_rows(self.max_steps, T.dtype),
        )

    def terminate(self, state: _State) -> Bool[Array, ""]:
        return state.change <= self.limit

    def fail(self, state: _State) -> Bool[Array, ""]:
        return jnp.isnan(state.change) | (state.num_steps >= self.at_most)

    def step(self, state: _State) -> _State:
        graph, before = self.graph, state.width
        width = self.width_of(graph, state.T, before)
        trust = self.trust_of(graph, state.T, width)
        T = self.step_of(graph, state.T, trust, width)
        moved = pose_change(graph, self.scale, state.T, T)
        trusted = weighted_mean(trust, graph.weight)
        rows = with_row(state.rows, state.num_steps, moved, width, trusted)
        shrinking = jnp.any(width < (1 - STILL) * before) & jnp.all(
            jnp.isfinite(before)
        )
        change = moved + jnp.where(shrinking, self.limit, 0)
        return _State(T, width, change, state.num_steps + 1, rows)


def pose_change(
    graph: PoseGraph, scale: Scalar, T_old: Array, T_new: Array
) -> Float[Array, ""]:
    """The largest rotation (radians) or shift, over the size of the scene.

    That is `scale`, the graph's `length_scale`, and how far held frames spread.
    """
    t_old, t_new = lie.translation(T_old), lie.translation(T_new)
    held, count = graph.held.astype(t_new.dtype), graph.num_held
    mean = jnp.sum(held[:, None] * t_new, axis=0) / count
    sq = jnp.sum((t_new - mean[None]) ** 2, axis=-1)
    spread = jnp.sqrt(jnp.sum(held * sq) / count)
    turn = jnp.sqrt(jnp.sum((lie.rotation(T_new) - lie.rotation(T_old)) ** 2, (-2, -1)))
    shift = jnp.sqrt(jnp.sum((t_new - t_old) ** 2, axis=-1)) / (scale + spread)
    return jnp.maximum(jnp.max(turn), jnp.max(shift))
