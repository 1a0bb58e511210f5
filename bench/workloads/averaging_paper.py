"""Tables I to III of the MCC paper on relative motions that jaxreg itself estimates."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.motion_scans import SETS, Motions, estimate
from bench.records import Metric, error
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import (
    MCC,
    AbstractAverager,
    Correntropy,
    LowRankSparse,
    MotionAveraging,
    PoseGraphLM,
    SpanningTree,
    WeightedMotionAveraging,
    average,
)
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error, translation_error


#: Scans, motions; mean, median, RMSE of rotation (rad) and translation (mm).
PAPER_MOTIONS = {
    "bunny": (10, 46, (0.0253, 0.0054, 0.0624), (2.4320, 0.0906, 6.1294)),
    "dragon": (15, 103, (0.1157, 0.0043, 0.4459), (4.5063, 0.6799, 12.9122)),
}
SEEDS = (0, 1)
#: Further than this from the truth, a motion counts as wrong; radians.
WRONG = 0.1


class Row(NamedTuple):
    """A row of Table III."""

    method: AbstractAverager
    from_lrs: bool = False
    weighted: bool = False  # whether edges weigh their overlap


ROWS = {
    "LRS": Row(LowRankSparse()),
    "G2O, from LRS": Row(PoseGraphLM(), from_lrs=True),
    "MA, from LRS": Row(MotionAveraging(), from_lrs=True),
    "wMA, from LRS": Row(WeightedMotionAveraging(), from_lrs=True, weighted=True),
    "MCC, from LRS": Row(MCC(), from_lrs=True),
    "default, from LRS": Row(Correntropy(), from_lrs=True),
    "MCC, from cycles": Row(MCC()),
    "MCC, from a tree, overlap": Row(MCC(initialiser=SpanningTree()), weighted=True),
    "default": Row(Correntropy()),
    "default, overlap": Row(Correntropy(), weighted=True),
}
#: The paper's e_R (rad) and e_t (mm).
PAPER_RESULTS = {
    "bunny": {
        "LRS": (0.0459, 3.5322),
        "G2O, from LRS": (0.0377, 2.6475),
        "MA, from LRS": (0.0522, 4.5743),
        "wMA, from LRS": (0.0269, 2.2822),
        "MCC, from LRS": (0.0086, 0.6749),
    },
    "dragon": {
        "LRS": (0.1962, 11.7375),
        "G2O, from LRS": (0.5644, 25.5545),
        "MA, from LRS": (0.5977, 20.5170),
        "wMA, from LRS": (0.1841, 13.7669),
        "MCC, from LRS": (0.0163, 1.3837),
    },
}


def cases(options: Options) -> Iterator[Case]:
    """A case per set of scans that is there and set of edges."""
    for name, (folder, scans, _) in SETS.items():
        if not (options.data / folder / scans).exists():
            continue
        seeds = [estimate(name, options.data, seed) for seed in SEEDS]
        for label in ("trusted", "share", "all"):
            uses = [edge_sets(name, motions)[label] for motions in seeds]
            yield Case(
                name=f"{name}, {label} edges",
                data=motions_in_words(name, seeds[0], uses[0]),
                methods=methods(name),
                trials=[_trial(*both) for both in zip(seeds, uses, strict=True)],
                judge=partial(judge, seeds, uses),
                repeats=3,
            )


def methods(name: str) -> list[Method]:
    """One for each row, and below it the paper's figures where there are any."""
    found = []
    for label, row in ROWS.items():
        text = written_out(row.method)
        found.append(Method(f"jaxreg {label}", "jaxreg", text, partial(_own, row)))
        if label in PAPER_RESULTS[name]:
            e_R, e_t = PAPER_RESULTS[name][label]
            metrics = [
                Metric("e_R", e_R, "rad", "down"),
                Metric("e_t", e_t, "mm", "down"),
            ]
            text = "on motions of its own"
            found.append(
                Method(f"the paper's {label}", "published", text, metrics=metrics)
            )
    return found


def edge_sets(name: str, motions: Motions) -> dict[str, np.ndarray]:
    """Rows of the motions that enter the averaging, by the name of the set."""
    num_scans, num_motions = PAPER_MOTIONS[name][:2]
    share = num_motions / (num_scans * (num_scans - 1))
    best = np.argsort(-motions.overlap, kind="stable")
    return {
        "trusted": np.flatnonzero(motions.trusted),
        "share": np.sort(best[: round(share * len(best))]),
        "all": np.arange(len(best)),
    }


def motion_errors(motions: Motions) -> tuple[np.ndarray, np.ndarray]:
    """Angle (rad) and distance of translations (mm) of each motion to the true one."""
    i, j = motions.edges.T
    T_true = np.linalg.inv(motions.T_true[i]) @ motions.T_true[j]
    R = np.swapaxes(T_true[:, :3, :3], 1, 2) @ motions.T_i_j[:, :3, :3]
    # The angle from the chord: exact for small ones, unlike the arc cosine.
    chord = np.linalg.norm(R - np.eye(3), axis=(1, 2)) / np.sqrt(8)
    shift = np.linalg.norm(motions.T_i_j[:, :3, 3] - T_true[:, :3, 3], axis=1)
    return 2 * np.arcsin(np.minimum(chord, 1)), shift


def motions_in_words(name: str, motions: Motions, use: np.ndarray) -> str:
    """Tables I and II in a line, the paper's figures beside ours."""
    angle, shift = (x[use] for x in motion_errors(motions))
    _, num, e_R, e_t = PAPER_MOTIONS[name]

    def three(values: tuple[float, ...]) -> str:
        return " / ".join(f"{x:.2g}" for x in values)

    def of(x: np.ndarray) -> tuple[float, float, float]:
        return float(np.mean(x)), float(np.median(x)), float(np.sqrt(np.mean(x**2)))

    return (
        f"{motions.name}: {len(use)} motions, {int(np.sum(angle > WRONG))} of them "
        f"wrong; mean / median / RMSE {three(of(angle))} rad, {three(of(shift))} mm; "
        f"the paper's {num}: {three(e_R)} rad, {three(e_t)} mm"
    )


def graphs(motions: Motions, use: np.ndarray) -> tuple[PoseGraph, PoseGraph]:
    """The motions in use, every edge of weight one, and of its overlap.

    Edges not in use are masked, so that all sets of edges share their compilations.
    """
    T_i_j, num = motions.T_i_j.astype(np.float32), len(motions.T_true)
    mask = np.isin(np.arange(len(T_i_j)), use)
    weight = motions.overlap.astype(np.float32)
    return (
        PoseGraph.from_edges(motions.edges, T_i_j, num, mask=mask),
        PoseGraph.from_edges(motions.edges, T_i_j, num, weight=weight, mask=mask),
    )


def _trial(motions: Motions, use: np.ndarray) -> tuple:
    plain, weighted = graphs(motions, use)
    return plain, weighted, average(plain, LowRankSparse()).T_world_i


def _own(
    row: Row, plain: PoseGraph, weighted: PoseGraph, T_lrs: jax.Array
) -> np.ndarray:
    init = T_lrs if row.from_lrs else None
    found = average(weighted if row.weighted else plain, row.method, init)
    return np.asarray(found.T_world_i)


def pose_errors(T_world_i: np.ndarray, motions: Motions) -> tuple[float, float]:
    """e_R and e_t of the paper with scan 0 as the common frame."""
    T, T_true = jnp.asarray(T_world_i), jnp.asarray(motions.T_true)
    return float(rotation_error(T, T_true)), float(translation_error(T, T_true))


def agreeing(graph: PoseGraph, T_world_i: Any) -> int:
    """How many edges have a rotation within `WRONG` of that of the poses."""
    squares = graph.differences(jnp.asarray(T_world_i))[0]
    # The Frobenius norm is that of a chord: 2 sqrt(2) sin(angle / 2).
    near = squares < 8 * np.sin(WRONG / 2) ** 2
    return int(jnp.sum(near & graph.mask))


def judge(
    seeds: list[Motions], uses: list[np.ndarray], answers: list[np.ndarray]
) -> Judged:
    """Means over the seeds."""
    rows = []
    for motions, use, T_world_i in zip(seeds, uses, answers, strict=True):
        plain, _ = graphs(motions, use)
        rows.append([*pose_errors(T_world_i, motions), agreeing(plain, T_world_i)])
    e_R, e_t, agree = np.mean(rows, axis=0).tolist()
    return Judged(
        [
            error("e_R", e_R, "rad", 2e-4),
            error("e_t", e_t, "mm", 0.02),
            Metric("agree", agree, "edges", "up"),
        ]
    )
