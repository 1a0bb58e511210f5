"""Tables I to III of the MCC paper on relative motions that jaxreg itself estimates.

Run: python -m bench.motion_tables [--data DIR] [--out DIR] [--seeds 2]
     [--only bunny|dragon] [--edges trusted|share|all] [--centred] [--repeats 30]

The motions are those of `jaxreg.reconstruct` without an initial guess, each pair of
scans once; with --out they are kept there and the rows are added to rows.jsonl, so that
the tables come again in seconds. DIR of --data holds the folders stanford_bunny and
stanford_dragon (else JAXREG_DATA, else ../shared/data); where one is absent, scans of a
generated sculpture stand in and are named.

What enters the averaging, --edges, all three by default:
  trusted  the pairs that `reconstruct` trusts (overlap of at least `min_overlap`);
  share    the pairs of largest overlap, the same share of all pairs as in the paper
           (46 of 90 ordered pairs of Bunny, 103 of 210 of Dragon);
  all      every pair, most of them of scans that share no surface.
Every edge weighs the same, except in wMA, where it weighs its overlap, the weight that
the registration gives, and in the rows that say so. The first rows of Table III start
at the poses of LRS; names with a comma start from the motions alone: at a consensus of
cycles ("MCC, cycles", "default, alone"), at the tree of largest overlap with overlaps
as weights ("MCC, tree", what `reconstruct` does), or at the consensus with overlaps as
weights ("default, overlap"). MCC is the published Algorithm 1, default `Correntropy()`.
"agree" counts the edges whose rotation is within 0.1 rad of that of the poses found:
poses that are wrong and agree with as many edges as the true ones cannot be told from
them by motions alone. G2O takes the identity as information, lengths in millimetres, as
in the paper. --centred averages in frames at the means of the scans, as `reconstruct`
does; errors remain those of the frames given. Times are medians of calls after the
first, without the start; first calls are apart: they compile for the first set of edges
of each object, unless a compilation cache is in use.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bench.motion_scans import SETS, Motions, estimate
from bench.timing import (
    Timed,
    cpu_model,
    in_turn,
    keep,
    num_cores,
    quartiles,
    timed,
    versions,
)
from jaxreg import Status
from jaxreg.averaging import (
    AbstractAverager,
    AveragingSolution,
    Correntropy,
    LowRankSparse,
    MotionAveraging,
    PoseGraphLM,
    SpanningTree,
    WeightedMotionAveraging,
    average,
)
from jaxreg.averaging.base import length_scale
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error, translation_error


#: Scans, motions; mean, median, RMSE of rotation (rad) and translation (mm).
PAPER_MOTIONS = {
    "bunny": (10, 46, (0.0253, 0.0054, 0.0624), (2.4320, 0.0906, 6.1294)),
    "dragon": (15, 103, (0.1157, 0.0043, 0.4459), (4.5063, 0.6799, 12.9122)),
}
#: e_R (rad), e_t (mm), time (s).
PAPER_RESULTS = {
    "bunny": {
        "Initial (LRS)": (0.0459, 3.5322, None),
        "G2O": (0.0377, 2.6475, 0.0372),
        "MA": (0.0522, 4.5743, 0.1221),
        "wMA": (0.0269, 2.2822, 0.1320),
        "MCC": (0.0086, 0.6749, 0.2563),
    },
    "dragon": {
        "Initial (LRS)": (0.1962, 11.7375, None),
        "G2O": (0.5644, 25.5545, 0.0339),
        "MA": (0.5977, 20.5170, 0.9533),
        "wMA": (0.1841, 13.7669, 0.4624),
        "MCC": (0.0163, 1.3837, 0.8753),
    },
}
FROM_LRS: dict[str, AbstractAverager] = {
    "G2O": PoseGraphLM(),
    "MA": MotionAveraging(),
    "wMA": WeightedMotionAveraging(),
    "MCC": Correntropy(width="paper"),
    "default": Correntropy(),
}
ALONE: dict[str, AbstractAverager] = {
    "MCC, cycles": Correntropy(width="paper"),
    "MCC, tree": Correntropy(width="paper", initialiser=SpanningTree()),
    "default, alone": Correntropy(),
    "default, overlap": Correntropy(),
}
#: Rows whose edges weigh their overlap.
WEIGHTED = ("wMA", "MCC, tree", "default, overlap")
#: Further than this from the truth, a motion counts as wrong; radians.
WRONG = 0.1


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


def statistics(x: np.ndarray) -> tuple[float, float, float]:
    """Mean, median and root mean square."""
    return float(np.mean(x)), float(np.median(x)), float(np.sqrt(np.mean(x**2)))


def table_of_motions(name: str, motions: Motions) -> list[dict]:
    """Prints Tables I and II, with the paper's row below; returns the rows."""
    angle, shift = motion_errors(motions)
    print(f"\n{motions.name}: {len(motions.T_true)} scans, unit mm; all pairs ", end="")
    print(f"registered in {motions.seconds:.0f} s (first call, with compilation)")
    print(f"{'Tables I, II':12}{'motions':>8}{'wrong':>7}", end="")
    print(f"{'e_R rad: mean, median, RMSE':>33}{'e_t mm: mean, median, RMSE':>33}")
    rows = []
    for label, use in edge_sets(name, motions).items():
        e_R, e_t = statistics(angle[use]), statistics(shift[use])
        wrong = int(np.sum(angle[use] > WRONG))
        print(f"{label:12}{len(use):8d}{wrong:7d}   " + _numbers(e_R, e_t))
        rows.append(
            {
                "table": "I and II",
                "edges": label,
                "motions": len(use),
                "wrong": wrong,
                "e_R": e_R,
                "e_t": e_t,
            }
        )
    _, num, e_R, e_t = PAPER_MOTIONS[name]
    print(f"{'paper':12}{num:8d}{'':7}   " + _numbers(e_R, e_t))
    return rows


def _numbers(e_R: tuple, e_t: tuple) -> str:
    return (
        "".join(f"{x:10.4f}" for x in e_R) + "   " + "".join(f"{x:10.4f}" for x in e_t)
    )


def graphs(
    motions: Motions, use: np.ndarray, T_given_used: np.ndarray
) -> tuple[PoseGraph, PoseGraph]:
    """The motions in use, every edge of weight one, and of its overlap.

    Edges not in use are masked, so that all sets of edges share their compilations.
    """
    i, j = motions.edges.T
    T_i_j = np.linalg.inv(T_given_used[i]) @ motions.T_i_j @ T_given_used[j]
    T_i_j = T_i_j.astype(np.float32)
    num, mask = len(motions.T_true), np.isin(np.arange(len(i)), use)
    weight = motions.overlap.astype(np.float32)
    return (
        PoseGraph.from_edges(motions.edges, T_i_j, num, mask=mask),
        PoseGraph.from_edges(motions.edges, T_i_j, num, weight=weight, mask=mask),
    )


def frames(motions: Motions, centred: bool) -> np.ndarray:
    """The frames in which averaging works: those of the files, or at the means."""
    T_given_used = np.tile(np.eye(4), (len(motions.centre), 1, 1))
    if centred:
        T_given_used[:, :3, 3] = motions.centre
    return T_given_used


def calls(
    plain: PoseGraph, weighted: PoseGraph
) -> tuple[Timed, dict[str, Callable[[], AveragingSolution]]]:
    """The first call of LRS, which is the start, and a call for each row."""

    def call(label: str, method: AbstractAverager, init: jax.Array | None) -> Callable:
        graph = weighted if label in WEIGHTED else plain
        return lambda: jax.block_until_ready(average(graph, method, init))

    lrs = call("Initial (LRS)", LowRankSparse(), None)
    start = timed(lrs)
    rows = {"Initial (LRS)": lrs}
    rows |= {k: call(k, m, start.value.T_world_i) for k, m in FROM_LRS.items()}
    return start, rows | {k: call(k, m, None) for k, m in ALONE.items()}


def table_of_poses(
    name: str,
    motions: Motions,
    label: str,
    use: np.ndarray,
    *,
    centred: bool,
    repeats: int,
) -> list[dict]:
    """Prints Table III for one set of edges, with the paper's figures; the rows."""
    T_given_used = frames(motions, centred)
    plain, weighted = graphs(motions, use, T_given_used)
    scale = float(length_scale(plain))
    start, methods = calls(plain, weighted)
    first, timings, failed = in_turn(methods, [()], repeats)
    first["Initial (LRS)"] = start
    paper = PAPER_RESULTS[name]
    agree = agreeing(plain, jnp.asarray(motions.T_true @ T_given_used, jnp.float32))
    print(f"\nTable III, {motions.name}, edges {label} ({len(use)}; ", end="")
    print(f"{agree} agree with the true poses), ", end="")
    print(f"{'centred' if centred else 'given'} frames, length scale {scale:.2g} mm")
    print(f"{'':17}{'e_R rad':>9}{'e_t mm':>9}{'time s':>8}{'paper:':>8}", end="")
    print(f"{'e_R':>8}{'e_t':>9}{'time':>8}{'status':>11}{'steps':>6}", end="")
    print(f"{'agree':>6}{'first s':>8}")
    rows = []
    for row in methods:
        if row in failed:
            print(f"{row:17}{failed[row]}")
            continue
        result = _row(plain, first[row], timings[row][0], motions, T_given_used)
        rows.append({"table": "III", "edges": label, "method": row, **result})
        rows[-1]["centred"] = centred
        print(
            f"{row:17}{result['e_R']:9.4f}{result['e_t']:9.3f}"
            f"{result['time'][1]:8.4f}{'':8}{_paper(paper.get(row))}"
            f"{result['status']:>11}{result['steps']:6d}{result['agree']:6d}"
            f"{result['first']:8.2f}",
            flush=True,
        )
    e_R, e_t = pose_errors(motions.T_refined, motions)
    print(f"{'reconstruct':17}{e_R:9.4f}{e_t:9.3f}   (refined on the scans)")
    return rows


def pose_errors(T_world_i: np.ndarray, motions: Motions) -> tuple[float, float]:
    """e_R and e_t of the paper with scan 0 as the common frame."""
    T, T_true = jnp.asarray(T_world_i), jnp.asarray(motions.T_true)
    return float(rotation_error(T, T_true)), float(translation_error(T, T_true))


def agreeing(graph: PoseGraph, T_world_i: jax.Array) -> int:
    """How many edges have a rotation within `WRONG` of that of the poses."""
    squares = graph.differences(T_world_i)[0]
    # The Frobenius norm is that of a chord: 2 sqrt(2) sin(angle / 2).
    near = squares < 8 * np.sin(WRONG / 2) ** 2
    return int(jnp.sum(near & graph.mask))


def _row(
    graph: PoseGraph,
    first: Timed,
    timings: list[Timed],
    motions: Motions,
    T_given_used: np.ndarray,
) -> dict:
    found: AveragingSolution = first.value
    T_world_i = np.asarray(found.T_world_i) @ np.linalg.inv(T_given_used)
    e_R, e_t = pose_errors(T_world_i, motions)
    return {
        "e_R": e_R,
        "e_t": e_t,
        "time": quartiles([x.wall for x in timings]),
        "first": first.wall,
        "status": Status(int(found.status)).name,
        "steps": int(found.num_steps),
        "agree": agreeing(graph, found.T_world_i),
    }


def _paper(row: tuple | None) -> str:
    if row is None:
        return f"{'':25}"
    e_R, e_t, seconds = row
    time = f"{'/':>8}" if seconds is None else f"{seconds:8.4f}"
    return f"{e_R:8.4f}{e_t:9.4f}{time}"


def main() -> None:
    """Prints the tables of each set and seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("JAXREG_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", choices=SETS)
    parser.add_argument("--edges", choices=("trusted", "share", "all"))
    parser.add_argument("--centred", action="store_true")
    parser.add_argument("--repeats", type=int, default=30)
    options = parser.parse_args()
    print(f"{cpu_model()}, {num_cores()} cores, {versions('jax', 'jaxlib')}, float32")
    for name in SETS:
        if options.only not in (None, name):
            continue
        for seed in range(options.seeds):
            motions = estimate(name, options.data, seed, options.out)
            rows = table_of_motions(name, motions)
            for label, use in edge_sets(name, motions).items():
                if options.edges in (None, label):
                    rows += table_of_poses(
                        name,
                        motions,
                        label,
                        use,
                        centred=options.centred,
                        repeats=options.repeats,
                    )
            common = {"set": motions.name, "seed": seed, "cpu": cpu_model()}
            path = None if options.out is None else options.out / "rows.jsonl"
            keep(rows, common, path)


if __name__ == "__main__":
    main()
