"""Motion averaging by least squares in the tangent space (MA and wMA of the paper).

Reference: Govindu 2004; Govindu and Pooja 2014; Guo, Zhu, Li et al. 2018 (weighted);
equations as in the MCC paper, 14-21.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_parts
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, starting_poses
from jaxreg.averaging.methods.shortest_paths import ShortestPaths
from jaxreg.averaging.steps.gradients import averaging_gradients
from jaxreg.averaging.steps.iterate import (
    STEP_TOLERANCE,
    Iterated,
    averaged,
    held_width,
    iterate,
    solution_of,
)
from jaxreg.averaging.steps.rows import AbstractRows, EqualRows, RootRows
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import flow_solver
from jaxreg.linear.small import after


class MotionAveraging(AbstractAverager):
    """Plain motion averaging: every edge counts the same, prior weights are ignored.

    Best without outliers. A few steps suffice.

    Attributes:
        max_steps: largest number of steps (static).
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many scene sizes (length scale of the graph plus spread of poses).
        initialiser: finds the start when `init` is None.

    Gradients: implicit at the fixed point with respect to `T_i_j`.
    """

    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = ShortestPaths()

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(self, initialiser=AbstractAverager)
        check_counts(self, max_steps=1)
        check_not_negative(self, "tolerance")

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        T_start = starting_poses(self.initialiser, graph, init, key)
        rows = EqualRows()
        return _least_squares(graph, T_start, rows, self.max_steps, self.tolerance)


class WeightedMotionAveraging(AbstractAverager):
    """Motion averaging in which each edge counts by its prior `weight`.

    Attributes:
        rows: `RootRows()` to minimise the sum of weight * |residual|^2, `WeightRows()`
            to scale the rows by the weight itself, as the MCC paper does (Eq. 17).
        max_steps: largest number of steps (static).
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many scene sizes (length scale of the graph plus spread of poses).
        initialiser: finds the start when `init` is None.

    Gradients: implicit at the fixed point with respect to `T_i_j` and `weight`.
    """

    rows: AbstractRows = RootRows()
    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = ShortestPaths()

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(self, rows=AbstractRows, initialiser=AbstractAverager)
        check_counts(self, max_steps=1)
        check_not_negative(self, "tolerance")

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        T_start = starting_poses(self.initialiser, graph, init, key)
        return _least_squares(graph, T_start, self.rows, self.max_steps, self.tolerance)


def _least_squares(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    rows: AbstractRows,
    max_steps: int,
    tolerance: Array | float,
) -> AveragingSolution:
    end = iterate_plain(graph, T_start, rows, max_steps=max_steps, tolerance=tolerance)
    return solution_of(graph, averaging_gradients(graph, end, _full_trust, rows))


def iterate_plain(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    rows: AbstractRows,
    *,
    max_steps: int,
    tolerance: Array | float,
) -> Iterated:
    """Averaging in which every edge is trusted; no gradients."""
    graph = jax.lax.stop_gradient(graph)
    # The start may come from LAPACK, too.
    weight = after(rows.squared(graph, jnp.ones_like(graph.weight)), T_start)
    solve = flow_solver(graph.edges, weight, graph.num_poses, STEP_TOLERANCE)

    return iterate(
        graph,
        T_start,
        jnp.full((2,), jnp.inf, T_start.dtype),
        held_width,
        _full_trust,
        lambda g, T, trust, width: averaged(g, T, solve),
        max_steps=max_steps,
        tolerance=tolerance,
    )


def _full_trust(graph: PoseGraph, T: Array, width: Array) -> Array:
    return jnp.ones_like(graph.weight)
