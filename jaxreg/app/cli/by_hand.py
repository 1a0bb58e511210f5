"""Motions that a person has looked at: left out, or taken as right."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

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
