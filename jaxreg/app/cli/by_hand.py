"""Motions that a person has looked at: left out, or taken as right."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from jaxreg.averaging import AveragingSolution, PoseGraphLM, average
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.errors import InputError


def motions_between(
    pairs: Sequence[str], graph: PoseGraph, ids: np.ndarray, option: str
) -> np.ndarray:
    """`(e,)` True for the motions between frames that are named as I,J.

    Raises:
        InputError: for words that are no pair, and pairs without a motion.
    """
    names, out = ids.astype(str)[np.asarray(graph.edges)], np.zeros(graph.num_edges)
    for pair in pairs:
        ends = [word.strip() for word in pair.split(",")]
        if len(ends) != 2:
            raise InputError(f"{option} {pair}: wanted two frames as I,J.")
        rows = (names == ends).all(axis=1) | (names == ends[::-1]).all(axis=1)
        if not rows.any():
            raise InputError(f"{option} {pair}: no motion between these two frames.")
        out[rows] = 1
    return out > 0


def left_out(graph: PoseGraph, rows: np.ndarray) -> PoseGraph:
    """The graph without some motions."""
    kept = jnp.asarray(np.asarray(graph.mask) & ~rows)
    weight = jnp.where(kept, graph.weight, 0)
    return eqx.tree_at(lambda g: (g.mask, g.weight), graph, (kept, weight))


def rooted(graph: PoseGraph, ids: np.ndarray) -> tuple[PoseGraph, np.ndarray, str]:
    """Frames so numbered that the largest part that hangs together has frame 0.

    Returns:
        The graph, the names of its frames, and what to tell of it, empty as a rule.
    """
    edges, num = np.asarray(graph.edges), graph.num_poses
    used = edges[np.asarray(graph.mask)]
    joined = sparse.coo_array((np.ones(len(used)), used.T), (num, num))
    part = connected_components(joined, directed=False)[1]
    sizes = np.bincount(part)
    if sizes[part[0]] == sizes.max():
        return graph, ids, ""
    largest = part == sizes.argmax()
    order = np.concatenate([np.flatnonzero(largest), np.flatnonzero(~largest)])
    number = np.argsort(order)
    moved = eqx.tree_at(lambda g: g.edges, graph, jnp.asarray(number[edges]))
    note = (
        f"The part of frame {ids[0]} has {sizes[part[0]]} of the frames, that of frame "
        f"{ids[order[0]]} has {sizes.max()}: poses are in the frame of the latter."
    )
    return moved, ids[order], note


def forced(
    graph: PoseGraph, sol: AveragingSolution, rows: np.ndarray, known: dict[str, Any]
) -> AveragingSolution:
    """Adjusted once more to the motions that are trusted, and to some in any case.

    Args:
        graph: that was averaged.
        sol: its solution.
        rows: the motions that are right.
        known: of the world.
    """
    kept = np.asarray(sol.edge_weight) > 0.5
    again = left_out(graph, ~(kept | rows))
    end = average(again, PoseGraphLM(), init=sol.T_world_i, **known)
    trust = jnp.where(jnp.asarray(rows), 1, sol.edge_weight)
    return eqx.tree_at(lambda s: s.edge_weight, end, trust)


def pairs_of(graph: PoseGraph, rows: np.ndarray, ids: np.ndarray) -> list[list[int]]:
    """Names of the frames of some motions, for result.json."""
    return ids[np.asarray(graph.edges)[rows]].tolist()
