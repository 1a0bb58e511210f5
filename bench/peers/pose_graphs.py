"""Pose graphs by GTSAM, as its users optimise them: from the motions alone.

Graphs of files are read by GTSAM itself, before the time is taken.
"""

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order


#: Deviations that it is told for motions without information: degrees, length.
SIGMAS = (2.0, 0.05)


class Found(NamedTuple):
    """Poses, and where the method tells, from 0 to 1 how far it trusts each motion."""

    T_world_i: np.ndarray  # (v, d+1, d+1)
    weight: np.ndarray | None


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
) -> Callable[[], Found]:
    """The same for motions `(e, 4, 4)` with deviations in radians and lengths."""
    lib: Any = importlib.import_module("gtsam")
    noise = lib.noiseModel.Diagonal.Sigmas(np.repeat([turn, shift], 3))
    factors = between(lib, edges, T_i_j, [noise] * len(edges))

    def solve() -> Found:
        begin = lib.InitializePose3.initialize(factors)
        values = lib.LevenbergMarquardtOptimizer(factors, begin).optimize()
        poses = np.stack([values.atPose3(v).matrix() for v in range(num)])
        return Found(poses, None)

    return solve


def between(
    lib: Any, edges: np.ndarray, T_i_j: np.ndarray, noises: Sequence[Any]
) -> Any:
    """A graph of motions in space or in the plane with the first pose held."""
    dim = T_i_j.shape[-1] - 1
    prior = lib.PriorFactorPose3 if dim == 3 else lib.PriorFactorPose2
    factor = lib.BetweenFactorPose3 if dim == 3 else lib.BetweenFactorPose2
    factors = lib.NonlinearFactorGraph()
    held = lib.noiseModel.Diagonal.Sigmas(np.full(6 if dim == 3 else 3, 1e-4))
    factors.add(prior(0, pose(lib, np.eye(dim + 1)), held))
    for (i, j), T, noise in zip(edges.tolist(), T_i_j, noises, strict=True):
        factors.add(factor(i, j, pose(lib, T), noise))
    return factors


def pose(lib: Any, T: np.ndarray) -> Any:
    """Of GTSAM, in space or in the plane."""
    if len(T) == 4:
        return lib.Pose3(T)
    return lib.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))


def tree_poses(edges: np.ndarray, T_i_j: np.ndarray, num: int) -> np.ndarray:
    """Poses chained along a breadth-first tree from frame 0."""
    rows = np.arange(1, len(edges) + 1)
    first = coo_array((rows, (edges[:, 0], edges[:, 1])), (num, num)).tocsr()
    order, parent = breadth_first_order(first, 0, directed=False)
    row = {(i, j): k for k, (i, j) in enumerate(edges.tolist())}
    T = np.tile(np.eye(T_i_j.shape[-1]), (num, 1, 1))
    for v in order[1:].tolist():
        p = int(parent[v])
        if (p, v) in row:
            T[v] = T[p] @ T_i_j[row[p, v]]
        else:
            T[v] = T[p] @ np.linalg.inv(T_i_j[row[v, p]])
    return T


def robust(
    edges: np.ndarray,
    T_i_j: np.ndarray,
    num: int,
    *,
    kernel: str,
    information: np.ndarray | None = None,
    T_start: np.ndarray | None = None,
    right: Sequence[int] = (),
) -> Found:
    """By graduated non-convexity or by robust kernels.

    Args:
        edges: `(e, 2)`.
        T_i_j: `(e, d+1, d+1)`.
        num: of poses.
        kernel: "GNC" (Geman-McClure, on all edges), "GNC TLS" (its truncated least
            squares), "Huber" (then Geman-McClure) or "Geman-McClure".
        information: `(e, k, k)`, translation first, else of `SIGMAS`.
        T_start: `(v, d+1, d+1)`, else along a breadth-first tree.
        right: edges that GNC is told to be right.
    """
    lib: Any = importlib.import_module("gtsam")
    T_i_j = T_i_j.astype(np.float64)
    T_start = tree_poses(edges, T_i_j, num) if T_start is None else T_start
    values = lib.Values()
    for v, T in enumerate(T_start):
        values.insert(v, pose(lib, T))
    noises = _noises(lib, len(edges), information)
    if kernel.startswith("GNC"):
        factors = between(lib, edges, T_i_j, noises)
        values, weight = _gnc(lib, factors, values, kernel, right)
    else:
        weight, models = None, lib.noiseModel
        last = [models.mEstimator.GemanMcClure]
        for shape in [models.mEstimator.Huber] * (kernel == "Huber") + last:
            wrapped = [models.Robust.Create(shape.Create(1.345), n) for n in noises]
            factors = between(lib, edges, T_i_j, wrapped)
            values = lib.LevenbergMarquardtOptimizer(factors, values).optimize()
    at = values.atPose3 if T_i_j.shape[-1] == 4 else values.atPose2
    return Found(np.stack([at(v).matrix() for v in range(num)]), weight)


def _gnc(
    lib: Any, factors: Any, values: Any, kernel: str, right: Sequence[int]
) -> tuple[Any, np.ndarray]:
    """Values, and the weight of each motion."""
    params = lib.GncLMParams()
    loss = lib.GncLossType
    params.setLossType(loss.TLS if kernel == "GNC TLS" else loss.GM)
    # Factor 0 is the prior.
    params.setKnownInliers([0, *(1 + np.asarray(right, int)).tolist()])
    optimizer = lib.GncLMOptimizer(factors, values, params)
    found = optimizer.optimize()
    return found, np.asarray(optimizer.getWeights())[1:]


def _noises(lib: Any, num: int, information: np.ndarray | None) -> list[Any]:
    """One for each motion."""
    if information is None:
        degrees, length = SIGMAS
        sigmas = np.array([np.deg2rad(degrees)] * 3 + [length] * 3)
        return [lib.noiseModel.Diagonal.Sigmas(sigmas)] * num
    # In space GTSAM has rotations first.
    order = [3, 4, 5, 0, 1, 2] if information.shape[-1] == 6 else [0, 1, 2]
    ordered = information[:, order][:, :, order]
    return [lib.noiseModel.Gaussian.Information(each) for each in ordered]


def robust_many(task: tuple[str, np.ndarray, np.ndarray, int]) -> np.ndarray:
    """Kernel, edges `(b, e, 2)`, motions `(b, e, 4, 4)` and number of poses."""
    kernel, edges, T_i_j, num = task
    found = [
        robust(e, T, num, kernel=kernel) for e, T in zip(edges, T_i_j, strict=True)
    ]
    return np.stack([each.T_world_i for each in found])
