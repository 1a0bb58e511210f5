"""Pose graphs by GTSAM, as its users optimise them: from the motions alone.

Graphs of files are read by GTSAM itself, before the time is taken.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order


#: Deviations that it is told for motions without information: degrees, length.
SIGMAS = (2.0, 0.05)


def g2o_solver(path: Path, dim: int) -> Callable[[], np.ndarray]:
    """Poses `(v, d+1, d+1)` by Levenberg-Marquardt, of the graph in a file.

    Starts at GTSAM's chordal relaxation in space. In the plane that does not exist, and
    its LAGO takes no full information, so it starts at the poses of the file.
    """
    lib: Any = importlib.import_module("gtsam")
    graph, start = lib.readG2o(str(path), dim == 3)

    def solve() -> np.ndarray:
        factors = lib.NonlinearFactorGraph(graph)
        if dim == 3:
            loose = lib.noiseModel.Diagonal.Variances(np.full(6, 1e-6))
            factors.add(lib.PriorFactorPose3(0, lib.Pose3(), loose))
            begin = lib.InitializePose3.initialize(factors)
        else:
            loose = lib.noiseModel.Diagonal.Variances(np.full(3, 1e-6))
            factors.add(lib.PriorFactorPose2(0, start.atPose2(0), loose))
            begin = start
        found = lib.LevenbergMarquardtOptimizer(factors, begin).optimize()
        at = found.atPose3 if dim == 3 else found.atPose2
        return np.stack([at(key).matrix() for key in range(found.size())])

    return solve


def large_lm(
    edges: np.ndarray, T_i_j: np.ndarray, num: int, turn: float, shift: float
) -> Callable[[], np.ndarray]:
    """The same for motions `(e, 4, 4)` with deviations in radians and lengths."""
    lib: Any = importlib.import_module("gtsam")
    noise = lib.noiseModel.Diagonal.Sigmas(np.repeat([turn, shift], 3))
    factors = between(lib, edges, T_i_j, noise)

    def solve() -> np.ndarray:
        begin = lib.InitializePose3.initialize(factors)
        values = lib.LevenbergMarquardtOptimizer(factors, begin).optimize()
        return np.stack([values.atPose3(v).matrix() for v in range(num)])

    return solve


def between(lib: Any, edges: np.ndarray, T_i_j: np.ndarray, noise: Any) -> Any:
    """A graph of motions in space with the first pose held."""
    factors = lib.NonlinearFactorGraph()
    held = lib.noiseModel.Diagonal.Sigmas(np.full(6, 1e-4))
    factors.add(lib.PriorFactorPose3(0, lib.Pose3(), held))
    for (i, j), T in zip(edges.tolist(), T_i_j, strict=True):
        factors.add(lib.BetweenFactorPose3(i, j, lib.Pose3(T), noise))
    return factors


def tree_poses(edges: np.ndarray, T_i_j: np.ndarray, num: int) -> np.ndarray:
    """Poses chained along a breadth-first tree from frame 0."""
    rows = np.arange(1, len(edges) + 1)
    first = coo_array((rows, (edges[:, 0], edges[:, 1])), (num, num)).tocsr()
    order, parent = breadth_first_order(first, 0, directed=False)
    row = {(i, j): k for k, (i, j) in enumerate(edges.tolist())}
    T = np.tile(np.eye(4), (num, 1, 1))
    for v in order[1:].tolist():
        p = int(parent[v])
        if (p, v) in row:
            T[v] = T[p] @ T_i_j[row[p, v]]
        else:
            T[v] = T[p] @ np.linalg.inv(T_i_j[row[v, p]])
    return T


def robust(
    edges: np.ndarray, T_i_j: np.ndarray, num: int, *, kernel: str
) -> np.ndarray:
    """Poses `(num, 4, 4)` by graduated non-convexity or by robust kernels.

    Args:
        edges: `(e, 2)`.
        T_i_j: `(e, 4, 4)`.
        num: of poses.
        kernel: "GNC" (Geman-McClure, on all edges) or "Huber" (then Geman-McClure).
    """
    lib: Any = importlib.import_module("gtsam")
    degrees, length = SIGMAS
    sigmas = np.array([np.deg2rad(degrees)] * 3 + [length] * 3)
    plain = lib.noiseModel.Diagonal.Sigmas(sigmas)
    values = lib.Values()
    T_i_j = T_i_j.astype(np.float64)
    for v, T in enumerate(tree_poses(edges, T_i_j, num)):
        values.insert(v, lib.Pose3(T))
    if kernel == "GNC":
        params = lib.GncLMParams()
        params.setLossType(lib.GncLossType.GM)
        params.setKnownInliers([0])  # the prior
        factors = between(lib, edges, T_i_j, plain)
        values = lib.GncLMOptimizer(factors, values, params).optimize()
    else:
        estimators = lib.noiseModel.mEstimator
        for shape in (estimators.Huber, estimators.GemanMcClure):
            noise = lib.noiseModel.Robust.Create(shape.Create(1.345), plain)
            factors = between(lib, edges, T_i_j, noise)
            values = lib.LevenbergMarquardtOptimizer(factors, values).optimize()
    return np.stack([values.atPose3(v).matrix() for v in range(num)])
