"""How good the default answer is: real and generated graphs, in two halves.

Choices are made on one half and checked once on the other:

    python -m bench.studies.averaging_objective --half choose

prints a line per kind of data and, with `--each`, one per graph. Real graphs are split
by their place in the order of the files, generated ones by seed.
"""

import argparse
import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bench.workloads.averaging_data import learning2sync
from bench.workloads.averaging_logs import Scene, _logs, frame_errors
from bench.workloads.averaging_outliers import SIZES, errors_of
from jaxreg.averaging import AveragingSolution, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors
from tests.averaging.graphs import folding_graph, noisy_grid, random_graph


HALVES = {"choose": 0, "check": 1}
#: A name and the figures of one graph.
Row = tuple[str, dict[str, float]]


def main() -> None:
    """Prints means over the graphs of each kind."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--half", choices=HALVES, required=True)
    parser.add_argument("--only", default="", help="kinds whose name begins so")
    parser.add_argument("--each", action="store_true", help="a line for each graph")
    args = parser.parse_args()
    first = HALVES[args.half]
    for kind, rows in KINDS.items():
        if not kind.startswith(args.only):
            continue
        begin, found = time.perf_counter(), list(rows(first))
        for name, figures in found if args.each else []:
            print(f"    {name}: {told(figures)}")
        mean = {k: float(np.mean([f[k] for _, f in found])) for k in found[0][1]}
        seconds = time.perf_counter() - begin
        print(
            f"{kind}, {len(found)} graphs: {told(mean)} ({seconds:.0f} s)", flush=True
        )


def told(figures: dict[str, float]) -> str:
    """In words."""
    return ", ".join(f"{k} {x:.3f}" for k, x in figures.items())


def data() -> Path:
    """Where the files are."""
    return Path(os.environ.get("JAXREG_DATA", "data"))


def scenes(first: int) -> Iterator[Row]:
    """Learning2Sync."""
    files = sorted((data() / "learning2sync_relative_poses").rglob("*.mat"))
    for path in files[first::2]:
        yield path.stem, _right(learning2sync(path), 5.0, 0.1)


def logs(first: int) -> Iterator[Row]:
    """3DMatch."""
    found = _logs(data() / "redwood_3dmatch_relative_poses")
    for k in range(first, len(found), 2):
        yield str(k), _right(found[k], 10.0, 0.3)


def _right(scene: Scene, degrees: float, metres: float) -> dict[str, float]:
    graph, T_true, known = scene
    found = average(graph)
    turn, shift = frame_errors(
        np.asarray(found.T_world_i), T_true, known, degrees, metres
    )
    right = (turn < degrees) & (shift < metres) & known
    return {"right": float(right.mean()), **_own(found)}


def _own(found: AveragingSolution) -> dict[str, float]:
    """What a solution says of itself."""
    evidence = float(found.log_evidence)
    return {"settled": float(found.status == 0), "evidence": evidence}


def random(outliers: float, num: int, edges: int, first: int) -> Iterator[Row]:
    """Graphs with a share of wrong motions; seeds 0 to 39."""
    for seed in range(first, 40, 2):
        X, ids, T, _ = random_graph(num, edges, outliers, seed)
        graph = PoseGraph.from_edges(ids, T.astype(np.float32), num)
        found, true = average(graph), jnp.asarray(X, jnp.float32)
        e_R, e_t, _, margin = errors_of(graph, found.T_world_i, true)
        right = bool(e_R < np.deg2rad(5)) and bool(e_t < 0.05)
        told = {"right": right, "as the truth": right or bool(margin >= 0)}
        yield str(seed), {**told, **_own(found)}


def grids(first: int) -> Iterator[Row]:
    """Noise alone: no motion is wrong, and the answer depends on no key."""
    for noise in (0.3, 0.5, 0.7, 1.0):
        for seed in range(first, 4, 2):
            X, ids, T = noisy_grid(4, seed, noise=noise)
            graph = PoseGraph.from_edges(ids, T.astype(np.float32))
            true = jnp.asarray(X, jnp.float32)
            found = [average(graph, key=jax.random.key(k)) for k in range(4)]
            trusted = [float(jnp.mean(f.edge_weight > 0.5)) for f in found]
            turns = [rotation_errors(f.T_world_i, true, "best") for f in found]
            told = {"least trusted": min(trusted), "most": max(trusted)}
            told["worst turn"] = max(float(jnp.mean(turn)) for turn in turns)
            yield f"noise {noise}, seed {seed}", {**told, **_own(found[0])}


def folding(first: int) -> Iterator[Row]:
    """Wrong motions that agree with each other in greater numbers."""
    for seed in range(first, 12, 2):
        X, _, ids, T = folding_graph(seed)
        found = average(PoseGraph.from_edges(ids, T.astype(np.float32)))
        true = jnp.asarray(X, jnp.float32)
        turn = rotation_errors(found.T_world_i, true, "best")
        yield str(seed), {"right": float(jnp.mean(turn) < 0.1), **_own(found)}


KINDS = {
    "scenes": scenes,
    "logs": logs,
    **{
        f"random {num}:{edges}, {outliers} wrong": (
            partial(random, outliers, num, edges)
        )
        for outliers in (0.3, 0.5)
        for num, edges in SIZES
    },
    "grids": grids,
    "folding": folding,
}


if __name__ == "__main__":
    main()
