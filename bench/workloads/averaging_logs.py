"""Real relative motions with real outliers: Learning2Sync's scenes, 3DMatch's logs."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import SIGMAS, robust
from bench.records import Metric
from bench.workloads.averaging_data import (
    chained,
    learning2sync,
    log,
    on_group,
)
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import (
    MCC,
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
    "MCC paper": MCC(initialiser=SpanningTree()),
    "default": Correntropy(),
}
#: Graph, true poses, frames that have one.
Scene = tuple[PoseGraph, np.ndarray, np.ndarray]


def cases(options: Options) -> Iterator[Case]:
    """A case for the scenes, one for the logs, where they are."""
    root = options.data / "learning2sync_relative_poses"
    scenes = [learning2sync(path) for path in sorted(root.rglob("*.mat"))]
    logs = _logs(options.data / "redwood_3dmatch_relative_poses")
    for name, found, degrees, metres in (
        ("33 indoor scenes, 5 degrees and 0.1 m", scenes, 5.0, 0.1),
        ("logs of fragments, 10 degrees and 0.3 m", logs, 10.0, 0.3),
    ):
        if found:
            yield Case(
                name=name,
                data=f"{len(found)} graphs of real motions",
                methods=methods(),
                trials=[(graph,) for graph, _, _ in found],
                judge=partial(judge, found, degrees, metres),
                reference="GTSAM GNC",
                warm_up=True,
            )


def _logs(root: Path) -> list[Scene]:
    scenes = []
    for path in sorted(root.rglob("*.log")):
        if "gt" in path.name:
            continue
        T_true, known = chained(
            [path.parent / "gt.log", path.parent / "3dlomatch_gt.log"]
        )
        # One shape for all logs: one compilation for each number of fragments.
        scenes.append((log(path).padded(800), T_true, known))
    return scenes


def methods() -> list[Method]:
    """All edges weigh the same, except where the order of the frames is told."""

    def own(method: AbstractAverager, graph: PoseGraph) -> np.ndarray:
        return np.asarray(average(graph, method).T_world_i)

    found = [
        Method(f"jaxreg {k}", "jaxreg", written_out(m), partial(own, m))
        for k, m in METHODS.items()
    ]
    text = f"{written_out(Correntropy())}, ten times the weight on consecutive frames"
    ordered = Method(
        "jaxreg default, order told",
        "jaxreg",
        text,
        lambda g: own(Correntropy(), told(g)),
    )
    text = f"from a breadth-first tree, deviations {SIGMAS[0]:g} degrees, {SIGMAS[1]:g}"
    return [
        *found,
        ordered,
        *(
            Method(name, "gtsam", text, partial(_gtsam, kernel))
            for name, kernel in (
                ("GTSAM GNC", "GNC"),
                ("GTSAM Huber, Geman-McClure", "Huber"),
            )
        ),
    ]


def told(graph: PoseGraph) -> PoseGraph:
    """The graph with ten times the weight on motions between consecutive frames."""
    consecutive = jnp.abs(graph.edges[:, 0] - graph.edges[:, 1]) == 1
    weight = jnp.where(consecutive, 10 * graph.weight, graph.weight)
    return eqx.tree_at(lambda g: g.weight, graph, weight)


def _gtsam(kernel: str, graph: PoseGraph) -> np.ndarray:
    keep = np.asarray(graph.mask)
    T_i_j = on_group(np.asarray(graph.T_i_j, np.float64)[keep])
    edges = np.asarray(graph.edges)[keep]
    return robust(edges, T_i_j, graph.num_poses, kernel=kernel).T_world_i


def judge(
    scenes: list[Scene], degrees: float, metres: float, answers: list[Any]
) -> Judged:
    """Right frames, in percent of all, mean over the scenes."""
    shares, near, far = [], [], []
    for (_, T_true, known), T in zip(scenes, answers, strict=True):
        turn, shift = frame_errors(np.asarray(T), T_true, known, degrees, metres)
        shares.append(((turn < degrees) & (shift < metres) & known).mean())
        near.append(float(np.median(turn)))
        far.append(float(np.median(shift)))
    return Judged(
        [
            Metric("right frames", 100 * float(np.mean(shares)), "%", "up", 3.0),
            Metric("e_rot", float(np.median(near)), "deg", "down"),
            Metric("e_trans", float(np.median(far)), "m", "down"),
        ],
        {"right frames": [100 * float(x) for x in shares]},
    )


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
