"""Poses to compare an answer with: motions chained from the first frame."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from jaxreg.averaging import AveragingSolution
from jaxreg.graph.pose_graph import PoseGraph


def chained(graph: PoseGraph, sol: AveragingSolution) -> AveragingSolution:
    """A solution with the poses of `ShortestPaths`, by SciPy: no program is compiled.

    Args:
        graph: concrete.
        sol: of it, whose poses are replaced.
    """
    weight = np.asarray(graph.weight, float)
    edges, used = np.asarray(graph.edges), np.flatnonzero(weight > 0)
    motions = np.asarray(graph.T_i_j, float)
    num, d = graph.num_poses, motions.shape[-1] - 1
    # Of two motions between the same frames the better one.
    used = used[np.argsort(-weight[used], kind="stable")]
    keys, best = np.unique(_keys(edges[used], num), return_index=True)
    used = used[best]
    i, j = edges[used].T
    distance, before = dijkstra(
        coo_array((1 / weight[used], (i, j)), (num, num)),
        directed=False,
        indices=0,
        return_predecessors=True,
    )
    order = np.argsort(distance, kind="stable")[1 : np.isfinite(distance).sum()]
    ways = np.stack([before[order], order], axis=1)
    row = used[np.searchsorted(keys, _keys(ways, num))]
    step, back = motions[row], edges[row, 1] != order
    step[back] = np.linalg.inv(step[back])
    T = np.tile(np.eye(d + 1), (num, 1, 1))
    for (start, k), T_start_k in zip(ways, step, strict=True):
        T[k] = T[start] @ T_start_k
    return dataclasses.replace(
        sol,
        T_world_i=jnp.asarray(T, sol.T_world_i.dtype),
        placed=jnp.asarray(np.isfinite(distance)),
    )


def _keys(pairs: np.ndarray, num: int) -> np.ndarray:
    """One number for each two frames, whichever comes first."""
    return np.sort(pairs.astype(np.int64), axis=1) @ np.array([num, 1])
