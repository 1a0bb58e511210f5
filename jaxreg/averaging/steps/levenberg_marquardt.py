"""Levenberg-Marquardt steps on all poses of a graph.

Unknowns are left tangents around the current poses, T_world_i <- exp(x_i) T_world_i;
poses are updated after each step, so they stay on the group. The error of an edge then
depends on x_j - x_i alone, and the Gauss-Newton matrix is a graph Laplacian with k x k
weights, which is never formed beyond blocks: conjugate gradients work on the edges.

Solvers of optimistix (`charts`) are slower, so they are not the default: they factor a
dense Jacobian, which of 200 poses in the plane and 600 edges takes 700 to 1,200 ms for
4.5 here, to the same 1e-8; only BFGS does without, in 46 ms and to 2e-6. Conjugate
gradients without a preconditioner had not converged after 2,000 rounds in one step on
sphere2500 (12 s; here 20 to 52 rounds, all steps in 0.4 s). Of the normal equations,
lineax' dense Cholesky takes the whole to 9 ms, its conjugate gradients to 70.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.loop import AbstractIteration, iterate
from jaxreg._core.restarts import ROUNDING
from jaxreg._core.solver import LinearSolver
from jaxreg._core.typing import Scalar
from jaxreg.averaging.measures import weighted_mean
from jaxreg.averaging.steps.edge_errors import AbstractEdgeError
from jaxreg.averaging.steps.iterate import STEP_TOLERANCE, pose_change
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.multigrid import Multigrid, multigrid
from jaxreg.linear.operator import GraphLaplacian, divergence
from jaxreg.linear.small import product
from jaxreg.linear.solvers import MultigridCG
from jaxreg.robust import AbstractKernel


# A preconditioner is built anew at so many times the rounds of its first use, and when
# a pose has moved by this share of the length of an edge: how turns of one end shift
# the other depends on where they are, and on it how stiff bends of long chains are.
_STALE, _MOVED = 2, 0.3
# Damping after the first refused step, and the least. There is none before: even 1e-9
# of the diagonal holds back the bending of a long chain, so that steps converge slowly.
_DAMPED = 1e-6


class Problem(NamedTuple):
    """The sum of loss(r' Omega r) over the edges; trust is its derivative."""

    graph: PoseGraph
    error: AbstractEdgeError
    precision: Array  # (e, m, m), or (e, m) if diagonal
    loss: Callable[[Array], Array]
    trust: Callable[[Array], Array]

    def squares(self, T: Array) -> Array:
        """The squared error r' Omega r of each edge."""
        r = self.errors(T)
        return jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1)

    def errors(self, T: Array) -> Array:
        """The error r of each edge."""
        return self.error.value(self.graph.predicted(T), self.graph.T_i_j)

    def _weighted(self, J: Array) -> Array:
        if self.precision.ndim == 2:
            return self.precision[..., None] * J
        return product(self.precision, J)

    def cost(self, T: Array) -> Array:
        """The objective."""
        return jnp.sum(self.loss(self.squares(T)))

    def normal(self, T: Array) -> tuple[Array, Array]:
        """J' Omega J `(e, k, k)` and J' Omega r `(e, k)` with respect to x_j - x_i."""
        predicted = self.graph.predicted(T)
        r = self.error.value(predicted, self.graph.T_i_j)
        # A left tangent of both ends turns the predicted motion from the right.
        J = product(
            self.error.jacobian(predicted, r),
            lie.adjoint(lie.inverse(T))[self.graph.edges[:, 1]],
        )
        WJ = self._weighted(J)
        force = jnp.sum(WJ * r[:, :, None], axis=-2)
        trust = self.trust(jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1))
        Q = product(jnp.swapaxes(J, -1, -2), trust[:, None, None] * WJ)
        return Q, trust[:, None] * force


def robust_problem(
    graph: PoseGraph,
    error: AbstractEdgeError,
    precision: Float[Array, "e ..."],
    kernel: AbstractKernel,
    width: Float[Array, ""],
) -> Problem:
    """The problem under a robust kernel of sqrt(r' Omega r)."""
    return Problem(
        graph,
        error,
        precision,
        eqx.Partial(_loss, kernel, width),
        eqx.Partial(_trust, kernel, width),
    )


def _loss(kernel: AbstractKernel, width: Array, square: Array) -> Array:
    return 2 * kernel.rho(square, width)


def _trust(kernel: AbstractKernel, width: Array, square: Array) -> Array:
    return kernel.weight(square, width)


class Minimum(NamedTuple):
    """Where Levenberg-Marquardt stopped."""

    T: Float[Array, "v D D"]
    converged: Bool[Array, ""]
    step: Int[Array, ""]
    cycle: "Cycle | None"
    trace: AveragingTrace | None


class Cycle(NamedTuple):
    """A multigrid cycle kept from step to step as long as it serves."""

    inverse: Multigrid  # of the normal equations at this or an earlier step
    usual: Int[Array, ""]  # rounds that it first took, 0 where it is to be built
    moved: Float[Array, ""]  # how far poses have moved since, at most


def no_cycle(problem: Problem, T: Float[Array, "v D D"]) -> Cycle:
    """One to be built."""
    graph = problem.graph
    shapes = jax.eval_shape(
        lambda: multigrid(
            GraphLaplacian.anchored(graph.edges, problem.normal(T)[0], graph.num_poses)
        )
    )
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return Cycle(blank, jnp.asarray(0, jnp.int32), jnp.zeros((), T.dtype))


def minimise(
    problem: Problem,
    T_start: Float[Array, "v D D"],
    max_steps: int,
    tolerance: Array | float,
    cycle: Cycle | None = None,
    linear_solver: LinearSolver | None = None,
) -> Minimum:
    """Steps until the next would lower the objective by less than `tolerance` of it.

    `cycle` may be that of a similar problem; a `linear_solver` solves without one.
    """
    limit = jnp.maximum(tolerance, 4 * jnp.finfo(T_start.dtype).eps)
    cycle = no_cycle(problem, T_start) if cycle is None else cycle
    length = problem.graph.length_scale
    descent = _Descent(problem, length, limit, max_steps, linear_solver)
    ended = iterate(descent, descent.init((T_start, cycle)), max_steps=max_steps)
    end = ended.state
    trace = AveragingTrace.of(end.rows, end.num_steps)
    return Minimum(end.T, ended.converged, end.num_steps, end.cycle, trace)


class _State(NamedTuple):
    T: Array
    cost: Array
    damping: Array
    cycle: Cycle
    gain: Array  # share of the cost that the last step took away
    next_gain: Array  # what the next one is expected to
    num_steps: Array
    rows: Array  # of the trace


class _Descent(AbstractIteration[tuple[Array, Cycle], _State]):
    """Damped steps from poses, with a cycle that may serve.

    `length` is that of a usual edge.
    """

    problem: Problem
    length: Scalar
    limit: Scalar
    max_steps: int
    linear_solver: LinearSolver | None

    def init(self, start: tuple[Array, Cycle]) -> _State:
        T, cycle = start
        cost = self.problem.cost(T)
        inf = jnp.full_like(cost, jnp.inf)
        return _State(
            T=T,
            cost=cost,
            damping=jnp.zeros_like(cost),
            cycle=cycle,
            gain=inf,
            next_gain=inf,
            num_steps=jnp.asarray(0, jnp.int32),
            rows=no_rows(self.max_steps, T.dtype),
        )

    def terminate(self, state: _State) -> Bool[Array, ""]:
        return state.next_gain <= self.limit

    def fail(self, state: _State) -> Bool[Array, ""]:
        return jnp.isnan(state.next_gain)

    def step(self, state: _State) -> _State:
        """One damped step, kept if it lowers the cost, as far as that is known."""
        s, problem = state, self.problem
        Q, force = problem.normal(s.T)
        graph = problem.graph
        matrix = GraphLaplacian.anchored(graph.edges, Q, graph.num_poses, s.damping)
        kept = (s.cycle.usual > 0) & (s.cycle.moved < _MOVED * self.length)
        inverse = s.cycle.inverse
        if self.linear_solver is None:
            inverse = control.cond(kept, lambda: inverse, lambda: multigrid(matrix))
        x, rounds = _tangents(matrix, force, self.linear_solver or inverse)
        T = lie.straightened(product(lie.exp(x), s.T))
        cost = problem.cost(T)
        # Poses are known better than their cost: a step that is lost in its rounding
        # may still be right.
        better = cost <= s.cost * (1 + ROUNDING * jnp.finfo(cost.dtype).eps)
        gain = jnp.where(
            s.cost > 0, (s.cost - cost) / jnp.where(s.cost > 0, s.cost, 1), 0
        )
        # A refused step calls for more damping, unless damping can help no more.
        refused = jnp.where(s.damping < 1e3, jnp.inf, 0)
        eased = jnp.where(s.damping > _DAMPED, s.damping / 10, 0)
        gain = jnp.where(better, gain, refused).astype(cost.dtype)
        # Steps converge at least linearly: each gains less than the one before. And
        # hardly faster, as conjugate gradients leave some of each step undone.
        left = STEP_TOLERANCE**0.5
        ratio = jnp.where(jnp.isfinite(s.gain), jnp.clip(gain / s.gain, left, 1), 1)
        damping = jnp.where(better, eased, jnp.maximum(s.damping * 30, _DAMPED))
        usual = jnp.where(kept, s.cycle.usual, jnp.maximum(rounds, 1))
        shift = jnp.max(jnp.abs(lie.translation(T) - lie.translation(s.T)))
        moved = jnp.where(kept, s.cycle.moved, 0) + jnp.where(better, shift, 0)
        moves = pose_change(graph, self.length, s.T, T)
        change = jnp.where(better, moves, 0)
        trusted = weighted_mean(problem.trust(problem.squares(s.T)), graph.weight)
        no_width = jnp.full((2,), jnp.inf, T.dtype)
        # A cycle without damping knows nothing of a damped matrix.
        stale = (rounds > _STALE * usual) | ~better
        return _State(
            T=jnp.where(better, T, s.T),
            cost=jnp.where(better, cost, s.cost),
            damping=damping,
            cycle=Cycle(inverse, jnp.where(stale, 0, usual), moved),
            gain=gain,
            next_gain=gain * ratio,
            num_steps=s.num_steps + 1,
            rows=with_row(s.rows, s.num_steps, change, no_width, trusted),
        )


def _tangents(
    matrix: GraphLaplacian, force: Array, solver: Multigrid | LinearSolver
) -> tuple[Array, Array]:
    """Left tangents x of the normal equations B' Q B x = -B' f, and the rounds.

    Pose 0 and poses that no weight holds stay.
    """
    rhs = -divergence(matrix.edges, force, len(matrix.own))[..., None]
    held = jnp.trace(matrix.blocks(), axis1=-2, axis2=-1) > 0
    if isinstance(solver, LinearSolver):
        eye = jnp.eye(rhs.shape[1], dtype=rhs.dtype)
        own = jnp.where(held[:, None, None], matrix.own, eye)
        matrix = GraphLaplacian(matrix.edges, matrix.weight, own)
        x = lx.linear_solve(matrix, rhs, solver.whole(rhs.dtype), throw=False).value
        rounds = jnp.asarray(0, jnp.int32)
    else:
        ours = MultigridCG(STEP_TOLERANCE, max_steps=300)
        state = ours.init(matrix, {"preconditioner": solver})
        x, _, stats = ours.compute(state, rhs, {})
        rounds = stats["num_steps"]
    # Damping leaves pose 0 some of the motion that all share.
    return jnp.where(held[:, None], x[..., 0] - x[:1, :, 0], 0), rounds
