"""Motion averaging by least squares in the tangent space (MA and wMA of the paper).

Reference: Govindu 2004; Govindu and Pooja 2014; Guo, Zhu, Li et al. 2018 (weighted);
equations as in the MCC paper, 14-21.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.compile import compiled
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, solution, start
from jaxreg.averaging.methods.spanning_tree import SpanningTree
from jaxreg.averaging.steps.iterate import (
    STEP_TOLERANCE,
    Iterated,
    RowsOf,
    averaged,
    averaging_gradients,
    held_width,
    iterate,
)
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import flow_solver


class MotionAveraging(AbstractAverager):
    """Plain motion averaging: every edge counts the same, prior weights are ignored.

    Best without outliers. A few steps suffice.

    Attributes:
        max_steps: largest number of steps (static).
        tolerance: stop below this change, radians and share of the size of the scene.
        initialiser: finds the start when `init` is None.

    Gradients: implicit at the fixed point with respect to `T_i_j`.
    """

    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = SpanningTree(by="path")

    @compiled
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""

        def rows(g: PoseGraph, trust: Array) -> Array:
            return (g.weight > 0).astype(trust.dtype)

        T_start = start(self.initialiser, graph, init, key)
        return _least_squares(graph, T_start, rows, self.max_steps, self.tolerance)


class WeightedMotionAveraging(AbstractAverager):
    """Motion averaging in which each edge counts by its prior `weight`.

    Attributes:
        rows: "sqrt" to minimise the sum of weight * |residual|^2, "weight" to scale the
            rows of the system by the weight itself, as the paper does (Eq. 17).
        max_steps: largest number of steps (static).
        tolerance: stop below this change, radians and share of the size of the scene.
        initialiser: finds the start when `init` is None.

    Gradients: implicit at the fixed point with respect to `T_i_j` and `weight`.
    """

    rows: Literal["sqrt", "weight"] = eqx.field(static=True, default="sqrt")
    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = SpanningTree(by="path")

    def __check_init__(self) -> None:
        check_rows(self.rows)

    @compiled
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        T_start = start(self.initialiser, graph, init, key)
        rows = scaled_rows(self.rows)
        return _least_squares(graph, T_start, rows, self.max_steps, self.tolerance)


def check_rows(rows: str) -> None:
    """Requires one of the two ways to scale rows."""
    if rows not in ("sqrt", "weight"):
        raise ValueError(f"rows: wanted 'sqrt' or 'weight', found {rows!r}.")


def scaled_rows(rows: str) -> RowsOf:
    """Laplacian weights for rows scaled by the weight or by its root."""

    def sqrt(g: PoseGraph, trust: Array) -> Array:
        return g.weight * trust

    def weight(g: PoseGraph, trust: Array) -> Array:
        return (g.weight * trust) ** 2

    return sqrt if rows == "sqrt" else weight


def _least_squares(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    rows: RowsOf,
    max_steps: int,
    tolerance: Array | float,
) -> AveragingSolution:
    end = iterate_plain(graph, T_start, rows, max_steps=max_steps, tolerance=tolerance)
    end = averaging_gradients(graph, end, _full_trust, rows)
    return solution(
        graph,
        end.T_world_i,
        converged=end.converged,
        num_steps=end.num_steps,
        trace=end.trace,
    )


def iterate_plain(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    rows: RowsOf,
    *,
    max_steps: int,
    tolerance: Array | float,
) -> Iterated:
    """Averaging in which every edge is trusted; no gradients."""
    graph = jax.lax.stop_gradient(graph)
    weight = rows(graph, jnp.ones_like(graph.weight))
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
