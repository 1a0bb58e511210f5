"""Levenberg-Marquardt on all poses of a graph (the G2O baseline of the MCC paper).

The steps are those of `jaxreg.averaging.steps.levenberg_marquardt`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.checks import (
    check_counts,
    check_not_negative,
    check_parts,
    check_positive,
)
from jaxreg._core.programs import kept_program
from jaxreg._core.solver import LinearSolver, Solver
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    solution,
    starting_poses,
)
from jaxreg.averaging.methods.motion_averaging import MotionAveraging
from jaxreg.averaging.steps.charts import Minimum as SolverMinimum
from jaxreg.averaging.steps.charts import minimise_by
from jaxreg.averaging.steps.edge_errors import AbstractEdgeError, LogError
from jaxreg.averaging.steps.edge_jacobian import edge_jacobian
from jaxreg.averaging.steps.edge_problem import Problem, robust_problem
from jaxreg.averaging.steps.implicit import differentiable
from jaxreg.averaging.steps.levenberg_marquardt import Minimum, minimise
from jaxreg.averaging.trace import AveragingTrace
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.carried import carried, carried_back
from jaxreg.linear.multigrid import multigrid
from jaxreg.linear.operator import GraphLaplacian, divergence
from jaxreg.robust import AbstractKernel


def _solver(found: object) -> Solver | None:
    return None if found is None else Solver.of(found, "PoseGraphLM: solver")


def _linear_solver(found: object) -> LinearSolver | None:
    told = "PoseGraphLM: linear_solver"
    return None if found is None else LinearSolver.of(found, told)


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
        solver: a minimiser or a least-squares solver of optimistix in place of the
            steps here. It works on tangents around the poses, and is started anew
            around those that it found until that changes nothing; `max_steps` is then
            that of each start, and there is no trace. Its numbers are traced.
        linear_solver: a solver of lineax for the normal equations of the steps here, in
            place of conjugate gradients under a multigrid cycle.

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
    initialiser: AbstractAverager = eqx.field(
        default_factory=lambda: MotionAveraging(max_steps=3)
    )
    solver: Solver | None = eqx.field(default=None, converter=_solver)
    linear_solver: LinearSolver | None = eqx.field(
        default=None, converter=_linear_solver
    )

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(
            self,
            error=AbstractEdgeError,
            kernel=AbstractKernel | None,
            initialiser=AbstractAverager,
        )
        check_counts(self, max_steps=1)
        check_positive(self, "kernel_width")
        check_not_negative(self, "tolerance")
        if self.solver is not None and self.linear_solver is not None:
            raise ValueError(
                "PoseGraphLM: linear_solver: the steps of `solver` have one of their "
                "own; give it to that, or leave out one of both."
            )

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Minimises the objective of a prepared graph."""
        fixed, held = jax.lax.stop_gradient((graph, self))
        T_start = jax.lax.stop_gradient(
            starting_poses(self.initialiser, fixed, init, key)
        )
        problem = held.problem(fixed)
        end, trace = held._minimum(problem, T_start)
        return self.solution_at(graph, end.T, end.converged, end.step, trace)

    def solution_at(
        self,
        graph: PoseGraph,
        T: Float[Array, "v D D"],
        converged: Bool[Array, ""],
        num_steps: Int[Array, ""],
        trace: AveragingTrace | None,
    ) -> AveragingSolution:
        """The solution where a minimum of the objective was found, with gradients."""
        fixed, held = jax.lax.stop_gradient((graph, self))
        T = self._with_gradients(graph, held.problem(fixed), T)
        problem = self.problem(graph)
        return solution(
            graph,
            T,
            edge_weight=problem.trust(problem.squares(T)),
            converged=converged,
            num_steps=num_steps,
            trace=trace,
        )

    def _minimum(
        self, problem: Problem, T_start: Float[Array, "v D D"]
    ) -> tuple[Minimum | SolverMinimum, AveragingTrace | None]:
        """By our steps or by those of the solver."""
        start = problem, T_start, self.max_steps, self.tolerance
        if self.solver is not None:
            return minimise_by(self.solver, *start), None
        end = minimise(*start, linear_solver=self.linear_solver)
        return end, end.trace

    def _with_gradients(
        self, graph: PoseGraph, problem: Problem, T: Float[Array, "v D D"]
    ) -> Float[Array, "v D D"]:
        """The same poses, with derivatives by the balance of forces at the minimum."""
        origin = lie.translation(T)
        Q = problem.normal(T, origin).stiffness
        stiffness = jnp.trace(Q, axis1=-2, axis2=-1)
        top = jnp.max(stiffness)
        weight = stiffness / jnp.where(top > 0, top, 1)
        precondition = eqx.Partial(_nearly_balanced, graph.edges, Q, origin)
        jacobian = eqx.Partial(edge_jacobian, self._imbalance)
        return differentiable(graph, T, self._imbalance, weight, jacobian, precondition)

    def _imbalance(self, graph: PoseGraph, T: Array) -> Array:
        force = self.problem(graph).normal(T).force
        return -divergence(graph.edges, force, graph.num_poses)

    def problem(self, graph: PoseGraph) -> Problem:
        """What is minimised."""
        error, precision = self.error, self.error.precision(graph)
        if self.kernel is None:
            return Problem(graph, error, precision, jnp.asarray, jnp.ones_like)
        width = jnp.asarray(self.kernel_width)
        return robust_problem(graph, error, precision, self.kernel, width)


def _nearly_balanced(edges: Array, Q: Array, origin: Array, rows: Array) -> Array:
    """Tangents that about undo an imbalance, both at the origin of the world."""
    # What arrives at pose 0 leaves the others.
    rows = rows.at[0].set(-jnp.sum(rows[1:], axis=0))
    matrix = GraphLaplacian.anchored(edges, Q, len(rows), origin=origin)
    x = multigrid(matrix)(carried_back(-rows[..., None], -origin))
    x = carried(x, -origin)[..., 0]
    return x - x[0]
