"""What was adjusted, of a solution whose frame is that of known poses or points."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import shown
from jaxreg._core.programs import kept_program
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.world.adjustment import Adjustment
from jaxreg.averaging.world.arguments import check_known
from jaxreg.graph.anchored import anchored
from jaxreg.graph.pose_graph import PoseGraph, check_graph


Told = Sequence[tuple[Any, ...]] | None


def check_solution(graph: PoseGraph, solution: AveragingSolution) -> None:
    """Requires a graph and a solution of it."""
    check_graph(graph, "graph")
    if not isinstance(solution, AveragingSolution):
        raise TypeError(
            f"solution: wanted an AveragingSolution, found {shown(solution)}."
        )
    v, D = graph.num_poses, graph.dim + 1
    if solution.T_world_i.shape != (v, D, D):
        raise ValueError(
            f"solution: T_world_i: wanted shape {(v, D, D)}, found "
            f"{solution.T_world_i.shape}."
        )
    if solution.edge_weight.shape != graph.weight.shape:
        raise ValueError(
            f"solution: wanted one of {graph.num_edges} edges, found "
            f"{solution.edge_weight.shape}."
        )


def as_adjusted(
    graph: PoseGraph,
    solution: AveragingSolution,
    priors: Told,
    fixed: Told,
    control: Told,
    levels: Told,
) -> tuple[PoseGraph, AveragingSolution, int]:
    """The graph and its solution, or those whose frame 0 is the world.

    Returns:
        A graph, its solution, and the frame in it that was frame 0: with knowledge
        all frames are one further, priors, control points and levels are its last
        edges, and fixed frames have no edges.
    """
    check_solution(graph, solution)
    known = check_known(priors, fixed, control, levels, graph)
    num = 0 if known is None else known.num_rows
    weight = solution.prior_weight
    told = 0 if weight is None else len(weight)
    if told != num:
        raise ValueError(
            f"solution: {told} priors, control points and levels were averaged, found "
            f"{num} here: give those that `average` was given."
        )
    if known is None:
        return graph, solution, 0
    T = np.array(solution.T_world_i)
    if known.origin is not None:
        T[:, :-1, -1] -= known.origin
    T = jnp.asarray(T, graph.T_i_j.dtype)
    own = solution.edge_weight
    told_weight = jnp.zeros(0) if weight is None else weight
    if num:
        rows = known.poses, known.points, known.levels
        whole = _whole(Adjustment(graph, *rows, own, solution.placed), T)
    else:
        whole = anchored(graph, known.poses)
    eye = jnp.eye(graph.dim + 1, dtype=T.dtype)[None]
    at = lambda s: (s.T_world_i, s.edge_weight, s.placed, s.prior_weight)  # noqa: E731
    placed = jnp.append(True, solution.placed)
    edge_weight = jnp.concatenate([own, told_weight])
    new = jnp.concatenate([eye, T]), edge_weight, placed, None
    solution = eqx.tree_at(at, solution, new, is_leaf=lambda x: x is None)
    return whole, solution, 1


@kept_program
def _whole(adjustment: Adjustment, T: Float[Array, "v D D"]) -> PoseGraph:
    """Edges and what is known as one graph whose frame 0 is the world."""
    graph, known, _ = adjustment.whole(T)
    return anchored(graph, known)
