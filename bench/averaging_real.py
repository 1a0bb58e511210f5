"""Motion averaging on real relative motions with real outliers.

Run: python -m bench.averaging_real [DATA]

DATA is the folder of the data sets (else JAXREG_DATA, else ../shared/data). Reads the
33 scenes of learning2sync_relative_poses (Fast Global Registration of all pairs of 50
views) and the 20 logs of redwood_3dmatch_relative_poses, and prints for each scene and
method the share of all frames that are within 5 degrees and 0.1 m (learning2sync) or 10
degrees and 0.3 m (logs) of the truth in the best common frame, which is the gauge of
the frame for which that share is largest. The order of the frames is used by "order
told" alone: the default with ten times the weight on motions between consecutive
frames. A second row for each gives mean and median errors, in degrees and metres and in
that frame, of the frames of the largest component that right edges join. Elsewhere all
edges weigh the same, so weighted averaging is plain averaging. GTSAM's Huber, then
Geman-McClure, starts at the spanning tree and is told deviations of 2 degrees and
0.05 m.
"""

import importlib.util
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.io
import scipy.sparse as sp

from jaxreg.averaging import (
    AbstractAverager,
    Correntropy,
    LowRankSparse,
    MotionAveraging,
    SpanningTree,
    average,
)
from jaxreg.graph import PoseGraph


METHODS: dict[str, AbstractAverager] = {
    "tree": SpanningTree(),
    "LRS": LowRankSparse(),
    "MA": MotionAveraging(),
    "MCC paper": Correntropy(width="paper", initialiser=SpanningTree()),
    "default": Correntropy(),
}


def data_dir() -> Path:
    """The folder of the data sets."""
    here = Path(__file__).parents[1] / ".." / "shared" / "data"
    return Path(
        sys.argv[1] if len(sys.argv) > 1 else os.environ.get("JAXREG_DATA", here)
    )


def on_group(T: np.ndarray) -> np.ndarray:
    """Rotations made orthonormal, last rows exact."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    sign = np.linalg.det(U @ Vt)
    U[..., -1] *= sign[..., None]
    out = np.zeros_like(T)
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = U @ Vt, T[..., :3, 3], 1
    return out


def learning2sync(path: Path) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """A scene as graph, true poses and frames that have one."""
    scene = scipy.io.loadmat(path)
    T_view_world = on_group(np.asarray(scene["Tstar"], dtype=np.float64))
    num = len(T_view_world)
    blocks = scene["T"].reshape(num, 4, num, 4).transpose(0, 2, 1, 3)
    i, j = np.triu_indices(num, 1)
    # The file maps view i into view j.
    T_i_j = np.linalg.inv(on_group(blocks[i, j]))
    graph = PoseGraph.from_edges(np.stack([i, j], 1), T_i_j.astype(np.float32), num)
    return graph, np.linalg.inv(T_view_world), np.ones(num, bool)


def read_log(path: Path) -> tuple[np.ndarray, np.ndarray, int]:
    """Pairs, motions and number of fragments of a Redwood log."""
    rows = np.array(path.read_text().split(), dtype=np.float64).reshape(-1, 19)
    return (
        rows[:, :2].astype(int),
        on_group(rows[:, 3:].reshape(-1, 4, 4)),
        int(rows[0, 2]),
    )


def chained(logs: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """True poses along the true pairs, and the frames of the largest component."""
    parts = [read_log(path) for path in logs if path.exists()]
    edges = np.concatenate([p[0] for p in parts])
    motions = np.concatenate([p[1] for p in parts])
    num = parts[0][2]
    best: dict[int, np.ndarray] = {}
    for root in range(num):
        poses = {root: np.eye(4)}
        grown = True
        while grown:
            grown = False
            for (i, j), T in zip(edges.tolist(), motions, strict=True):
                if i in poses and j not in poses:
                    poses[j], grown = poses[i] @ T, True
                elif j in poses and i not in poses:
                    poses[i], grown = poses[j] @ np.linalg.inv(T), True
        if len(poses) > len(best):
            best = poses
        if 2 * len(best) > num:
            break
    T = np.tile(np.eye(4), (num, 1, 1))
    known = np.zeros(num, bool)
    for v, pose in best.items():
        T[v], known[v] = pose, True
    return T, known


def frame_errors(
    T: np.ndarray, T_true: np.ndarray, known: np.ndarray, degrees: float, metres: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angles (degrees) and lengths in the common frame that has most frames right."""
    T = T.astype(np.float64)
    errors, most = (np.zeros(0), np.zeros(0)), -1
    for v in np.flatnonzero(known):
        moved = T_true[v] @ np.linalg.inv(T[v]) @ T
        shift = np.linalg.norm(moved[:, :3, 3] - T_true[:, :3, 3], axis=1)
        turn = angles(moved[:, :3, :3], T_true[:, :3, :3])
        right = ((turn < degrees) & (shift < metres) & known).sum()
        if right > most:
            errors, most = (turn, shift), right
    return errors


def angles(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Between rotations, degrees."""
    cosine = (np.einsum("vij,vij->v", A, B) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def joined(
    graph: PoseGraph,
    T_true: np.ndarray,
    known: np.ndarray,
    degrees: float,
    metres: float,
) -> np.ndarray:
    """The frames of the largest component that right edges join."""
    i, j = np.asarray(graph.edges).T
    T_i_j, num = np.asarray(graph.T_i_j, dtype=np.float64), len(T_true)
    gap = np.linalg.inv(T_true[i]) @ T_true[j]
    right = angles(gap[:, :3, :3], T_i_j[:, :3, :3]) < degrees
    right &= np.linalg.norm(gap[:, :3, 3] - T_i_j[:, :3, 3], axis=1) < metres
    right &= known[i] & known[j] & np.asarray(graph.mask)
    ones = np.ones(right.sum())
    near = sp.coo_matrix((ones, (i[right], j[right])), (num, num))
    label = sp.csgraph.connected_components(near, directed=False)[1]
    return label == np.bincount(label).argmax()


def by_gtsam(graph: PoseGraph) -> np.ndarray:
    """Poses by Huber's kernel, then Geman-McClure's, from the spanning tree."""
    import gtsam  # pyright: ignore[reportMissingImports]

    sigmas = np.array([np.deg2rad(2)] * 3 + [0.05] * 3)
    plain = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    poses = np.asarray(average(graph, SpanningTree()).T_world_i, dtype=np.float64)
    values = gtsam.Values()
    for v, T in enumerate(on_group(poses)):
        values.insert(v, gtsam.Pose3(T))
    edges, T_i_j = (
        np.asarray(graph.edges),
        on_group(np.asarray(graph.T_i_j, np.float64)),
    )
    for kernel in (
        gtsam.noiseModel.mEstimator.Huber,
        gtsam.noiseModel.mEstimator.GemanMcClure,
    ):
        noise = gtsam.noiseModel.Robust.Create(kernel.Create(1.345), plain)
        factors = gtsam.NonlinearFactorGraph()
        factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), plain))
        for e in np.flatnonzero(np.asarray(graph.mask)):
            i, j = edges[e].tolist()
            factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T_i_j[e]), noise))
        values = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    return np.stack([values.atPose3(v).matrix() for v in range(graph.num_poses)])


def told(graph: PoseGraph) -> PoseGraph:
    """The graph with ten times the weight on motions between consecutive frames."""
    consecutive = jnp.abs(graph.edges[:, 0] - graph.edges[:, 1]) == 1
    weight = jnp.where(consecutive, 10 * graph.weight, graph.weight)
    return eqx.tree_at(lambda g: g.weight, graph, weight)


def solvers() -> dict[str, Callable[[PoseGraph], np.ndarray]]:
    """All methods: poses from a graph."""

    def ours(method: AbstractAverager) -> Callable[[PoseGraph], np.ndarray]:
        return lambda graph: np.asarray(average(graph, method).T_world_i)

    found = {name: ours(method) for name, method in METHODS.items()}
    found["order told"] = lambda graph: ours(Correntropy())(told(graph))
    if importlib.util.find_spec("gtsam") is None:
        print("GTSAM: not installed")
        return found
    return {"GTSAM": by_gtsam, **found}


def table(title: str, cases: dict, degrees: float, metres: float) -> None:
    """Scores all methods on all scenes."""
    methods = solvers()
    print(f"{title:40}" + "".join(f"{name:>24}" for name in methods))
    shares, times = [], []
    for name, (graph, T_true, known) in cases.items():
        connected = joined(graph, T_true, known, degrees, metres)
        row, details, spent = [], [], []
        for method in methods.values():
            begin = time.perf_counter()
            T = method(graph)
            spent.append(time.perf_counter() - begin)
            turn, shift = frame_errors(T, T_true, known, degrees, metres)
            row.append(((turn < degrees) & (shift < metres) & known).mean())
            turn, shift = turn[connected], shift[connected]
            details.append(
                f"{turn.mean():.1f}/{np.median(turn):.1f} "
                f"{shift.mean():.2f}/{np.median(shift):.2f}"
            )
        shares.append(row)
        times.append(spent)
        print(f"{name:40}" + "".join(f"{x:24.3f}" for x in row))
        print(f"{'':40}" + "".join(f"{x:>24}" for x in details), flush=True)
    mean, middle = np.mean(shares, axis=0), np.median(times, axis=0)
    print(f"{'mean':40}" + "".join(f"{x:24.3f}" for x in mean))
    print(f"{'ms, median':40}" + "".join(f"{1e3 * x:24.1f}" for x in middle))


def main() -> None:
    """Prints both tables."""
    root = data_dir()
    scenes = sorted((root / "learning2sync_relative_poses").rglob("*.mat"))
    cases = {path.stem[-38:]: learning2sync(path) for path in scenes}
    table("learning2sync", cases, 5, 0.1)
    logs = {}
    for path in sorted((root / "redwood_3dmatch_relative_poses").rglob("*.log")):
        if "gt" in path.name:
            continue
        folder = path.parent
        T_true, known = chained([folder / "gt.log", folder / "3dlomatch_gt.log"])
        edges, T_i_j, num = read_log(path)
        graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32), num)
        # One shape for all logs: one compilation for each number of fragments.
        logs[f"{folder.name[:24]} {path.stem}"] = (graph.padded(800), T_true, known)
    table("3DMatch and Redwood logs", logs, 10, 0.3)


if __name__ == "__main__":
    main()
