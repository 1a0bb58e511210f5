"""Motion averaging on real relative motions with real outliers.

Run: python -m bench.averaging_real [DATA]

DATA is the folder of the data sets (else JAXREG_DATA, else ../shared/data). Reads the
33 scenes of learning2sync_relative_poses (Fast Global Registration of all pairs of 50
views) and the 20 logs of redwood_3dmatch_relative_poses, and prints for each scene and
method the share of all frames that are within 5 degrees and 0.1 m (learning2sync) or 10
degrees and 0.3 m (logs) of the truth in the best common frame, which is the gauge of
the frame for which that share is largest. The order of the frames is not used.
"""

import os
import sys
import time
from pathlib import Path

import jax
import numpy as np
import scipy.io

from jaxreg.averaging import (
    AbstractAverager,
    Correntropy,
    MotionAveraging,
    SpanningTree,
    average,
)
from jaxreg.graph import PoseGraph


METHODS: dict[str, AbstractAverager] = {
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


def right_share(
    T: np.ndarray, T_true: np.ndarray, known: np.ndarray, degrees: float, metres: float
) -> float:
    """The share of frames that are right in the best common frame."""
    T = T.astype(np.float64)
    best = 0.0
    for v in np.flatnonzero(known):
        moved = T_true[v] @ np.linalg.inv(T[v]) @ T
        shift = np.linalg.norm(moved[:, :3, 3] - T_true[:, :3, 3], axis=1)
        cosine = (np.einsum("vij,vij->v", moved[:, :3, :3], T_true[:, :3, :3]) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        right = (turn < degrees) & (shift < metres) & known
        best = max(best, right.sum() / len(T))
    return best


def table(title: str, cases: dict, degrees: float, metres: float) -> None:
    """Scores all methods on all scenes."""
    print(f"{title:40}" + "".join(f"{name:>12}" for name in METHODS))
    shares = []
    for name, (graph, T_true, known) in cases.items():
        row = []
        for method in METHODS.values():
            solution = jax.block_until_ready(average(graph, method))
            T = np.asarray(solution.T_world_i)
            row.append(right_share(T, T_true, known, degrees, metres))
        shares.append(row)
        print(f"{name:40}" + "".join(f"{x:12.3f}" for x in row), flush=True)
    mean = np.mean(shares, axis=0)
    print(f"{'mean':40}" + "".join(f"{x:12.3f}" for x in mean))
    times = []
    graph = next(iter(cases.values()))[0]
    for method in METHODS.values():
        begin = time.perf_counter()
        jax.block_until_ready(average(graph, method))
        times.append(time.perf_counter() - begin)
    print(f"{'ms, first scene':40}" + "".join(f"{1e3 * x:12.1f}" for x in times))


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
