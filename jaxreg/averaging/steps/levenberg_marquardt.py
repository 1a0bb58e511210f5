"""Levenberg-Marquardt steps on all poses of a graph.

Unknowns are left tangents, taken at a point near each pose; poses are updated after
each step, so they stay on the group. The error of an edge then depends on x_j - x_i
alone, seen from one point, and the Gauss-Newton matrix is a graph Laplacian with k x k
weights, which is never formed beyond blocks: conjugate gradients work on the edges.

Tangents at the origin of the world are the same in exact arithmetic. In float32 they
lost a scene 2,000 edges long: stiffness against turns drowns in the square of the
distance, steps raised the cost and conjugate gradients ran to their limit.

Solvers of optimistix (`charts`) are slower, so they are not the default: they factor a
dense Jacobian, which of 200 poses in the plane and 600 edges takes 700 to 1,200 ms for
4.5 here, to the same 1e-8; only BFGS does without, in 46 ms and to 2e-6. Conjugate
gradients without a preconditioner had not converged after 2,000 rounds in one step on
sphere2500 (12 s; here 20 to 52 rounds, all steps in 0.4 s). Of the normal equations,
lineax' dense Cholesky takes the whole to 9 ms, its conjugate gradients to 70.
"""

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
from jaxreg.averaging.steps.edge_problem import Normal, Problem
from jaxreg.averaging.steps.iterate import STEP_TOLERANCE, pose_change
from jaxreg.averaging.trace import AveragingTrace, no_rows, with_row
from jaxreg.geometry import lie
from jaxreg.linear.carried import carried
from jaxreg.linear.chains import Chained, near_inverse
from jaxreg.linear.multigrid import Multigrid
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.small import product
from jaxreg.linear.solvers import MultigridCG


# A preconditioner is built anew at so many times the rounds of its first use, and when
# a pose has moved by this share of the length of an edge: how turns of one end shift
# the other depends on where they are, and on it how stiff bends of long chains are.
_STALE, _MOVED = 2, 0.3
# Damping after the first refused step, and the least. There is none before: even 1e-9
# of the diagonal holds back the bending of a long chain, so that steps converge slowly.
_DAMPED = 1e-6
# Share of a step that is tried last before it is damped.
_SHORTEST = 1 / 8
# Of the gain that ends the descent, what conjugate gradients may leave.
_SPARED = 1e-4


class Minimum(NamedTuple):
    """Where Levenberg-Marquardt stopped."""

    T: Float[Array, "v D D"]
    converged: Bool[Array, ""]
    step: Int[Array, ""]
    cycle: "Cycle | None"
    trace: AveragingTrace | None


class Cycle(NamedTuple):
    """A multigrid cycle kept from step to step as long as it serves."""

    inverse: Multigrid | Chained  # of the normal equations at this or an earlier step
    origin: Float[Array, "v d"]  # where its tangents are taken
    usual: Int[Array, ""]  # rounds that it first took, 0 where it is to be built
    moved: Float[Array, ""]  # how far poses have moved since, at most


def no_cycle(problem: Problem, T: Float[Array, "v D D"]) -> Cycle:
    """One to be built."""
    origin = lie.translation(T)
    shapes = jax.eval_shape(lambda: near_inverse(_matrix(problem, T, origin, 0.0)[0]))
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    none = jnp.zeros((), T.dtype)
    return Cycle(blank, origin, jnp.asarray(0, jnp.int32), none)


def _matrix(
    problem: Problem, T: Array, origin: Array, damping: Array | float
) -> tuple[GraphLaplacian, Normal]:
    """The Gauss-Newton matrix of tangents at `origin`, and what edges give to it."""
    graph, of_edges = problem.graph, problem.normal(T, origin)
    args = graph.edges, of_edges.stiffness, graph.num_poses, damping, origin
    return GraphLaplacian.anchored(*args), of_edges


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
        kept = (s.cycle.usual > 0) & (s.cycle.moved < _MOVED * self.length)
        inverse = s.cycle.inverse
        origin = jnp.where(kept, s.cycle.origin, lie.translation(s.T))
        matrix, of_edges = _matrix(problem, s.T, origin, s.damping)
        if self.linear_solver is None:
            inverse = control.cond(kept, lambda: inverse, lambda: near_inverse(matrix))
        # What is left of the system then would gain less than what ends the descent.
        spared = _SPARED * self.limit * s.cost
        x, rounds = _tangents(
            matrix, of_edges.force, self.linear_solver or inverse, spared
        )
        enough = s.cost + _rounding(s.T, s.cost, of_edges)
        T, cost = _far_enough(problem, s.T, x, origin, enough)
        better = cost <= enough
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
        moves = pose_change(problem.graph, self.length, s.T, T)
        change = jnp.where(better, moves, 0)
        trusted = weighted_mean(of_edges.trust, problem.graph.weight)
        no_width = jnp.full((2,), jnp.inf, T.dtype)
        # A cycle without damping knows nothing of a damped matrix.
        stale = (rounds > _STALE * usual) | ~better
        return _State(
            T=jnp.where(better, T, s.T),
            cost=jnp.where(better, cost, s.cost),
            damping=damping,
            cycle=Cycle(inverse, origin, jnp.where(stale, 0, usual), moved),
            gain=gain,
            next_gain=gain * ratio,
            num_steps=s.num_steps + 1,
            rows=with_row(s.rows, s.num_steps, change, no_width, trusted),
        )


def _rounding(T: Array, cost: Array, of_edges: Normal) -> Float[Array, ""]:
    """What rounding may change a cost by: its own, and that of the positions.

    Poses are known better than their cost: a step that is lost in its rounding is right
    all the same. Positions are rounded by their distance from the origin, and each edge
    tells by its force what that costs.
    """
    place, force = lie.translation(T), of_edges.force[:, : T.shape[-1] - 1]
    far = jnp.sqrt(jnp.mean(jnp.sum(place**2, axis=-1)) * jnp.sum(force**2))
    return jnp.finfo(cost.dtype).eps * (ROUNDING * cost + far)


def _far_enough(
    problem: Problem, T: Array, x: Array, origin: Array, enough: Array
) -> tuple[Float[Array, "v D D"], Float[Array, ""]]:
    """Poses after a step or the first half of it, of that, ..., that costs enough less.

    A damped step is solved for anew; of a million poses one takes a minute.
    """

    def at(share: Array) -> tuple[Array, Array, Array]:
        return (*_best_of_ways(problem, T, share * x, origin), share)

    def too_far(found: tuple[Array, Array, Array]) -> Array:
        _, cost, share = found
        return ~(cost <= enough) & (share > _SHORTEST)

    whole = at(jnp.ones_like(enough))
    T, cost, _ = control.while_loop(too_far, lambda found: at(found[2] / 2), whole)
    return T, cost


def _best_of_ways(
    problem: Problem, T: Array, x: Array, origin: Array
) -> tuple[Float[Array, "v D D"], Float[Array, ""]]:
    """Poses after a step, and their cost: along screws, or straight.

    Between neighbours that turn by w and w + u, and shift by v, poses that go along
    screws, the arcs of exp(x), leave the step by u x v / 2: on a tube 2,000 edges long
    more than the noise, so that whole steps raised the cost. Poses that turn where they
    are and shift on straight lines stretch an edge by w^2 / 2: too much for
    parking-garage, which turns alike over long distances.
    """
    place, d = lie.translation(T), T.shape[-1] - 1
    at_place = carried(x[..., None], place - origin)[..., 0]
    arc = lie.exp(at_place)
    turned = product(lie.rotation(arc), lie.rotation(T))
    shifts = jnp.stack([lie.translation(arc), at_place[:, :d]])
    turned = jnp.broadcast_to(turned, (2, *turned.shape))
    ways = lie.straightened(lie.compose(turned, place[None] + shifts))
    costs = jax.lax.map(problem.cost, ways)
    best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
    return ways[best], costs[best]


def _tangents(
    matrix: GraphLaplacian,
    force: Array,
    solver: Multigrid | Chained | LinearSolver,
    spared: Array,
) -> tuple[Array, Array]:
    """Left tangents x of the normal equations B' Q B x = -B' f, and the rounds.

    Pose 0 and poses that no weight holds stay.
    """
    rhs = -matrix.divergence(force[..., None])
    held = jnp.trace(matrix.blocks(), axis1=-2, axis2=-1) > 0
    if isinstance(solver, LinearSolver):
        eye = jnp.eye(rhs.shape[1], dtype=rhs.dtype)
        own = jnp.where(held[:, None, None], matrix.own, eye)
        matrix = eqx.tree_at(lambda m: m.own, matrix, own)
        x = lx.linear_solve(matrix, rhs, solver.whole(rhs.dtype), throw=False).value
        rounds = jnp.asarray(0, jnp.int32)
    else:
        ours = MultigridCG(STEP_TOLERANCE, max_steps=300)
        state = ours.init(matrix, {"preconditioner": solver})
        x, _, stats = ours.compute(state, rhs, {"energy": spared})
        rounds = stats["num_steps"]
    # Damping leaves pose 0 some of the motion that all share.
    assert matrix.origin is not None
    shared = jnp.broadcast_to(x[:1], x.shape)
    shared = carried(shared, matrix.origin - matrix.origin[:1])
    return jnp.where(held[:, None], (x - shared)[..., 0], 0), rounds
