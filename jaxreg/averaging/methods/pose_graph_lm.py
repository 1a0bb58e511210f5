"""Levenberg-Marquardt on all poses of a graph (the G2O baseline of the MCC paper).

Unknowns are left tangents around the current poses, T_world_i <- exp(x_i) T_world_i;
poses are updated after each step, so they stay on the group. The error of an edge then
depends on x_j - x_i alone, and the Gauss-Newton matrix is a graph Laplacian with k x k
weights, which is never formed beyond blocks: conjugate gradients work on the edges.

optimistix is not used: `LevenbergMarquardt` takes no preconditioner for J' J, and
without one a step on sphere2500 had not converged after 2,000 rounds (12 s; here 20 to
52 rounds, all steps in 0.4 s).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    length_scale,
    solution,
    start,
    weighted_mean,
)
from jaxreg.averaging.methods.motion_averaging import MotionAveraging
from jaxreg.averaging.steps.edge_errors import AbstractEdgeError, LogError
from jaxreg.averaging.steps.implicit import differentiable
from jaxreg.averaging.steps.iterate import nearby_rotation, pose_change
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, product
from jaxreg.linear.block_system import solve_block_flow
from jaxreg.linear.laplacian import divergence
from jaxreg.linear.multigrid import Multigrid, anchored, matmul, multigrid
from jaxreg.robust import AbstractKernel


# A preconditioner is built anew at so many times the rounds of its first use, and when
# a pose has moved by this share of the length of an edge: how turns of one end shift
# the other depends on where they are, and on it how stiff bends of long chains are.
_STALE, _MOVED = 2, 0.3
# Share of a step's gain that conjugate gradients may leave to the next.
_UNDONE = 0.1
# Damping after the first refused step, and the least. There is none before: even 1e-9
# of the diagonal holds back the bending of a long chain, so that steps converge slowly.
_DAMPED, _LEAST = 1e-6, 1e-9


class PoseGraphLM(AbstractAverager):
    """Least squares over the graph, with information matrices.

    Attributes:
        error: what is minimised, the sum of r' Omega r. `LogError()`: the tangent error
            r = log(inv(T_i_j) inv(T_world_i) T_world_j) of g2o and GTSAM, Omega the
            weight times the information (the identity without); `ChordalError()`: the
            objective of SE-Sync, `jaxreg.metrics.chordal_objective`.
        kernel: a robust kernel of `jaxreg.robust` over sqrt(r' Omega r) of each edge,
            or None for plain least squares, which outliers pull away.
        kernel_width: its width; in standard deviations if the information is that of
            the noise.
        max_steps: largest number of steps (static).
        tolerance: stop when the next step would lower the objective by less than this
            share, by the ratio of the last two.
        initialiser: finds the start when `init` is None.

    The length unit matters without information, as an error of one radian counts as
    one of a unit length. `edge_weight` is the kernel's.

    Gradients: implicit at the minimum with respect to `T_i_j`, `weight`, `information`
    and `kernel_width`; the start is cut.

    Reference: Kuemmerle, Grisetti et al. 2011 (g2o); Rosen et al. 2019 (SE-Sync).
    """

    error: AbstractEdgeError = LogError()
    kernel: AbstractKernel | None = None
    kernel_width: Array | float = traced(3.0)
    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-6)
    initialiser: AbstractAverager = MotionAveraging(max_steps=3)

    @eqx.filter_jit
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Minimises the objective of a prepared graph."""
        fixed, held = jax.lax.stop_gradient((graph, self))
        T_start = jax.lax.stop_gradient(start(self.initialiser, fixed, init, key))
        problem = held._problem(fixed)
        end = minimise(problem, T_start, self.max_steps, held.tolerance)
        T = self._with_gradients(graph, problem, end.T)
        problem = self._problem(graph)
        return solution(
            graph,
            T,
            edge_weight=problem.trust(problem.squares(T)),
            converged=end.converged,
            num_steps=end.step,
            trace=end.trace,
        )

    def _with_gradients(
        self, graph: PoseGraph, problem: "Problem", T: Float[Array, "v D D"]
    ) -> Float[Array, "v D D"]:
        """The same poses, with derivatives by the balance of forces at the minimum."""
        Q = problem.normal(T)[0]
        stiffness = jnp.trace(Q, axis1=-2, axis2=-1)
        top = jnp.max(stiffness)
        weight = stiffness / jnp.where(top > 0, top, 1)
        precondition = eqx.Partial(_nearly_balanced, graph.edges, Q)
        return differentiable(graph, T, self._imbalance, weight, precondition)

    def _imbalance(self, graph: PoseGraph, T: Array) -> Array:
        force = self._problem(graph).normal(T)[1]
        return -divergence(graph.edges, force, graph.num_poses)

    def _problem(self, graph: PoseGraph) -> "Problem":
        error, precision = self.error, self.error.precision(graph)
        if self.kernel is None:
            return Problem(graph, error, precision, lambda s: s, jnp.ones_like)
        width = jnp.asarray(self.kernel_width)
        return robust_problem(graph, error, precision, self.kernel, width)


def _nearly_balanced(edges: Array, Q: Array, rows: Array) -> Array:
    """Tangents that about undo an imbalance."""
    # What arrives at pose 0 leaves the others.
    rows = rows.at[0].set(-jnp.sum(rows[1:], axis=0))
    x = multigrid(anchored(edges, Q, len(rows)))(-rows[..., None])[..., 0]
    return x - x[0]


class Problem(NamedTuple):
    """The sum of loss(r' Omega r) over the edges; trust is its derivative."""

    graph: PoseGraph
    error: AbstractEdgeError
    precision: Array  # (e, m, m), or (e, m) if diagonal
    loss: Callable[[Array], Array]
    trust: Callable[[Array], Array]

    def squares(self, T: Array) -> Array:
        """The squared error r' Omega r of each edge."""
        r = self.error.value(_predicted(self.graph, T), self.graph.T_i_j)
        return jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1)

    def _weighted(self, J: Array) -> Array:
        if self.precision.ndim == 2:
            return self.precision[..., None] * J
        return matmul(self.precision, J)

    def cost(self, T: Array) -> Array:
        """The objective."""
        return jnp.sum(self.loss(self.squares(T)))

    def normal(self, T: Array) -> tuple[Array, Array]:
        """J' Omega J `(e, k, k)` and J' Omega r `(e, k)` with respect to x_j - x_i."""
        i, j = self.graph.edges[:, 0], self.graph.edges[:, 1]
        T_i_world = lie.inverse(T)
        predicted = product(T_i_world[i], T[j])
        r = self.error.value(predicted, self.graph.T_i_j)
        # A left tangent of both ends turns the predicted motion from the right.
        J = matmul(self.error.jacobian(predicted, r), lie.adjoint(T_i_world)[j])
        WJ = self._weighted(J)
        force = jnp.sum(WJ * r[:, :, None], axis=-2)
        trust = self.trust(jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1))
        Q = matmul(jnp.swapaxes(J, -1, -2), trust[:, None, None] * WJ)
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
        lambda s: 2 * kernel.rho(s, width),
        lambda s: kernel.weight(s, width),
    )


class Minimum(NamedTuple):
    """Where Levenberg-Marquardt stopped."""

    T: Float[Array, "v D D"]
    converged: Bool[Array, ""]
    step: Int[Array, ""]
    cycle: "Cycle"
    trace: AveragingTrace | None


class Cycle(NamedTuple):
    """A multigrid cycle kept from step to step as long as it serves."""

    inverse: Multigrid  # of the normal equations at this or an earlier step
    usual: Int[Array, ""]  # rounds that it first took, 0 where it is to be built
    moved: Float[Array, ""]  # how far poses have moved since, at most


def no_cycle(problem: "Problem", T: Float[Array, "v D D"]) -> Cycle:
    """One to be built."""
    graph = problem.graph
    shapes = jax.eval_shape(
        lambda: multigrid(anchored(graph.edges, problem.normal(T)[0], graph.num_poses))
    )
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return Cycle(blank, jnp.asarray(0, jnp.int32), jnp.zeros((), T.dtype))


def minimise(
    problem: Problem,
    T_start: Float[Array, "v D D"],
    max_steps: int,
    tolerance: Array | float,
    cycle: Cycle | None = None,
) -> Minimum:
    """Steps until the next would lower the objective by less than `tolerance` of it.

    `cycle` may be that of a similar problem.
    """
    cost = problem.cost(T_start)
    limit = jnp.maximum(tolerance, 4 * jnp.finfo(cost.dtype).eps)
    zero, inf = jnp.zeros_like(cost), jnp.full_like(cost, jnp.inf)
    begin = _State(
        T=T_start,
        cost=cost,
        damping=zero,
        cycle=no_cycle(problem, T_start) if cycle is None else cycle,
        length=length_scale(problem.graph),
        gain=inf,
        next_gain=inf,
        step=jnp.asarray(0, jnp.int32),
        rows=no_rows(max_steps, T_start.dtype),
    )
    end = jax.lax.while_loop(
        lambda s: (s.next_gain > limit) & (s.step < max_steps),
        lambda s: _try_step(problem, s),
        begin,
    )
    trace = AveragingTrace.of(end.rows, end.step)
    return Minimum(end.T, end.next_gain <= limit, end.step, end.cycle, trace)


class _State(NamedTuple):
    T: Array
    cost: Array
    damping: Array
    cycle: Cycle
    length: Array  # of a usual edge
    gain: Array  # share of the cost that the last step took away
    next_gain: Array  # what the next one is expected to
    step: Array
    rows: Array  # of the trace


def _predicted(graph: PoseGraph, T: Array) -> Array:
    return product(lie.inverse(T)[graph.edges[:, 0]], T[graph.edges[:, 1]])


def _try_step(problem: Problem, s: _State) -> _State:
    """One damped step, kept if it lowers the cost."""
    Q, force = problem.normal(s.T)
    graph = problem.graph
    matrix = anchored(graph.edges, Q, graph.num_poses, s.damping)
    kept = (s.cycle.usual > 0) & (s.cycle.moved < _MOVED * s.length)
    inverse = jax.lax.cond(kept, lambda: s.cycle.inverse, lambda: multigrid(matrix))
    x, rounds = solve_block_flow(matrix, force, inverse, tolerance=1e-2)
    T = nearby_rotation(product(lie.exp(x), s.T))
    cost = problem.cost(T)
    better = cost <= s.cost
    gain = jnp.where(s.cost > 0, (s.cost - cost) / jnp.where(s.cost > 0, s.cost, 1), 0)
    # A refused step calls for more damping, unless damping can help no more.
    refused = jnp.where(s.damping < 1e3, jnp.inf, 0)
    eased = jnp.where(s.damping > _LEAST, s.damping / 10, 0)
    gain = jnp.where(better, gain, refused).astype(cost.dtype)
    # Steps converge at least linearly: each gains less than the one before. And hardly
    # faster, as conjugate gradients leave some of each step undone.
    ratio = jnp.where(jnp.isfinite(s.gain), jnp.clip(gain / s.gain, _UNDONE, 1), 1)
    damping = jnp.where(better, eased, jnp.maximum(s.damping * 30, _DAMPED))
    usual = jnp.where(kept, s.cycle.usual, jnp.maximum(rounds, 1))
    shift = jnp.max(jnp.abs(lie.translation(T) - lie.translation(s.T)))
    moved = jnp.where(kept, s.cycle.moved, 0) + jnp.where(better, shift, 0)
    change = jnp.where(better, pose_change(s.T, T, s.length), 0)
    trusted = weighted_mean(problem.trust(problem.squares(s.T)), graph.weight)
    no_width = jnp.full((2,), jnp.inf, T.dtype)
    # A cycle without damping knows nothing of a damped matrix.
    stale = (rounds > _STALE * usual) | ~better
    return _State(
        T=jnp.where(better, T, s.T),
        cost=jnp.where(better, cost, s.cost),
        damping=damping,
        cycle=Cycle(inverse, jnp.where(stale, 0, usual), moved),
        length=s.length,
        gain=gain,
        next_gain=gain * ratio,
        step=s.step + 1,
        rows=with_row(s.rows, s.step, change, no_width, trusted),
    )
