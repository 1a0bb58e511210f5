"""Robot mapping with false loop closures: averaging from the motions alone.

Run: python -m bench.robot_mapping [--data DIR] [--out DIR] [--seeds 3]
     [--shares 0 0.1 0.3] [--graphs parking-garage intel]

Reads published graphs (DIR of --data holds pose_graphs, else JAXREG_DATA, else
../shared/data) and adds false loop closures, a stated share of the file's own: two
random poses, with the motion and the information of a true closure taken at random, as
from a place that looks like another. The numbers of the frames are kept, the poses of
the file are not used. In float64:

  odometry   the edges between successive poses, chained
  MA         MotionAveraging()
  LM         PoseGraphLM(), least squares with information (G2O of the MCC paper)
  MCC        Correntropy(), from the motions alone
  MCC, odo   the same from the odometry
  MCC paper  Correntropy(width="paper") from the odometry, as the paper does

Columns: SE-Sync's objective of the true edges over that of the clean optimum (chordal
LM on the file as it is, printed beside the published optimum); mean and largest
distance from the clean optimum in the best common frame, in metres, and mean angle;
false edges trusted and true closures distrusted (more or less than 1/2); time of a call
after the first. With --out, the rows are added to rows.jsonl and trajectories_10.png
etc. show the first seed of each share (notebooks/robot_mapping.png is that of 30 %).
"""

import argparse
import os
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


jax.config.update("jax_enable_x64", True)

from bench.motion_plot import Panel, trajectories_figure  # noqa: E402
from bench.timing import (  # noqa: E402
    cpu_model,
    keep,
    num_cores,
    timed,
    versions,
)
from jaxreg import Status  # noqa: E402
from jaxreg.averaging import (  # noqa: E402
    AbstractAverager,
    Correntropy,
    MotionAveraging,
    PoseGraphLM,
    average,
)
from jaxreg.graph import PoseGraph  # noqa: E402
from jaxreg.io.g2o import read_g2o  # noqa: E402
from jaxreg.metrics import (  # noqa: E402
    align_poses,
    chordal_objective,
    rotation_errors,
    translation_errors,
)


#: Optima of SE-Sync's objective.
OPTIMA = {"parking-garage": 1.262524, "intel": 52.3482, "MIT": 61.1541}
METHODS: dict[str, AbstractAverager] = {
    "MA": MotionAveraging(),
    "LM": PoseGraphLM(),
    "MCC": Correntropy(),
    "MCC, odo": Correntropy(),
    "MCC paper": Correntropy(width="paper"),
}
#: Started at the odometry; the others have the motions alone.
FROM_ODOMETRY = ("MCC, odo", "MCC paper")
DRAWN = {
    "odometry": "odometry",
    "MA": "plain MA",
    "LM": "LM (G2O)",
    "MCC": "MCC",
    "MCC, odo": "MCC from odometry",
    "MCC paper": "MCC as published",
}


class Case(NamedTuple):
    """A graph with false closures."""

    graph: PoseGraph
    false: np.ndarray  # (e,)
    T_odometry: jax.Array


def with_false_closures(
    clean: PoseGraph, share: float, seed: int, num_edges: int
) -> Case:
    """Adds false closures at the end, and masked edges up to `num_edges`."""
    rng = np.random.default_rng([round(100 * share), seed])
    edges = np.asarray(clean.edges)
    chain = np.abs(edges[:, 0] - edges[:, 1]) == 1
    count = round(share * int(np.sum(~chain)))
    pairs = _distant_pairs(rng, clean.num_poses, count)
    copied = rng.choice(np.flatnonzero(~chain), count)
    rows = np.concatenate([np.arange(len(edges)), copied])
    information = clean.information
    assert information is not None  # g2o files have it
    graph = PoseGraph.from_edges(
        np.concatenate([edges, pairs]),
        clean.T_i_j[rows],
        clean.num_poses,
        information=information[rows],
    )
    false = np.arange(num_edges) >= len(edges)
    return Case(graph.padded(num_edges), false, _chained(clean))


def _distant_pairs(rng: np.random.Generator, num_poses: int, count: int) -> np.ndarray:
    """Random pairs i < j at least a twentieth of the path apart."""
    i, j = np.triu_indices(num_poses, num_poses // 20)
    return np.stack([i, j], axis=1)[rng.choice(len(i), count, replace=False)]


def _chained(graph: PoseGraph) -> jax.Array:
    """Poses along the edges between successive frames, the first of each pair."""
    edges, T_i_j = np.asarray(graph.edges), np.asarray(graph.T_i_j)
    step: dict[int, np.ndarray] = {}
    for (i, j), T in zip(edges.tolist(), T_i_j, strict=True):
        if abs(i - j) == 1:
            step.setdefault(min(i, j), T if i < j else np.linalg.inv(T))
    poses = [np.eye(graph.dim + 1)]
    for k in range(graph.num_poses - 1):
        poses.append(poses[-1] @ step[k])
    return jnp.asarray(np.stack(poses))


def judge(clean: PoseGraph, T: jax.Array, T_clean: jax.Array) -> dict[str, float]:
    """Objective of the true edges and distances from the clean optimum."""
    best = chordal_objective(clean, T_clean)
    shift = translation_errors(T, T_clean, "best")
    return {
        "objective ratio": float(chordal_objective(clean, T) / best),
        "e_t mean": float(jnp.mean(shift)),
        "e_t max": float(jnp.max(shift)),
        "e_R mean": float(jnp.mean(rotation_errors(T, T_clean, "best"))),
    }


def run(case: Case, clean: PoseGraph, T_clean: jax.Array, first: dict) -> list[dict]:
    """All methods on one graph; `first` keeps the first call of each method."""
    rows = [{"method": "odometry", "T": case.T_odometry}]
    rows[0] |= judge(clean, case.T_odometry, T_clean)
    edges = np.asarray(case.graph.edges)
    mask = np.asarray(case.graph.mask)
    closure = ~case.false & (np.abs(edges[:, 0] - edges[:, 1]) != 1)
    for name, method in METHODS.items():
        init = case.T_odometry if name in FROM_ODOMETRY else None
        args = (case.graph, method, init)
        if name not in first:
            first[name] = timed(lambda a=args: jax.block_until_ready(average(*a))).wall
        solution, _, seconds = timed(lambda a=args: jax.block_until_ready(average(*a)))
        trusted = np.asarray(solution.edge_weight) > 0.5
        rows.append(
            {
                "method": name,
                "T": solution.T_world_i,
                **judge(clean, solution.T_world_i, T_clean),
                "false trusted": int(np.sum(trusted & case.false & mask)),
                "true distrusted": int(np.sum(~trusted & closure)),
                "closures": int(np.sum(closure)),
                "false": int(np.sum(case.false & mask)),
                "status": Status(int(solution.status)).name,
                "steps": int(solution.num_steps),
                "time": seconds,
                "first": first[name],
            }
        )
    return rows


def show(row: dict, share: float, seed: int, odometry: float) -> None:
    """Prints a row; 'no gain' where it is no nearer than the odometry."""
    print(
        f"{share:6.0%}{seed:5d} {row['method']:10}{row['objective ratio']:11.4g}"
        f"{row['e_t mean']:10.4g}{row['e_t max']:10.4g}{row['e_R mean']:9.4f}",
        end="",
    )
    if "status" in row:
        false = f"{row['false trusted']}/{row['false']}"
        true = f"{row['true distrusted']}/{row['closures']}"
        verdict = "" if row["e_t mean"] < 0.99 * odometry else "  no gain"
        print(
            f"{false:>11}{true:>11}{row['status']:>11}{row['steps']:6d}"
            f"{row['time']:8.2f}{row['first']:8.1f}{verdict}",
            end="",
        )
    print(flush=True)


def study(
    name: str, path: Path, shares: list[float], seeds: int
) -> tuple[list[dict], dict[float, list[Panel]]]:
    """All rows of one graph, and the panels of each share, first seed."""
    clean = read_g2o(path)
    edges = np.asarray(clean.edges)
    closures = int(np.sum(np.abs(edges[:, 0] - edges[:, 1]) != 1))
    found = average(clean, PoseGraphLM(objective="chordal"))
    T_clean = found.T_world_i
    value = float(chordal_objective(clean, T_clean))
    print(
        f"\n{name}: {clean.num_poses} poses in {clean.dim}D, {len(edges)} edges", end=""
    )
    print(f", {closures} of them loop closures; clean optimum: objective", end="")
    print(f" {value:.7g}, published {OPTIMA.get(name, 'unknown')}")
    print(
        f"{'false':>6}{'seed':>5} {'method':10}{'objective':>12}{'e_t m':>10}", end=""
    )
    print(f"{'max':>10}{'e_R rad':>9}{'false kept':>11}{'true lost':>11}", end="")
    print(f"{'status':>11}{'steps':>6}{'time s':>8}{'first s':>8}")
    most = len(edges) + round(max(shares) * closures)
    rows, panels, first = [], {}, {}
    for share in shares:
        for seed in range(seeds if share else 1):
            case = with_false_closures(clean, share, seed, most)
            results = run(case, clean, T_clean, first)
            if seed == 0 and share:
                panels[share] = _panels(name, share, case, results, T_clean)
            for row in results:
                show(row, share, seed, results[0]["e_t mean"])
                del row["T"]
                rows.append({"graph": name, "share": share, "seed": seed, **row})
    return rows, panels


def _panels(
    name: str, share: float, case: Case, rows: list[dict], T_clean: jax.Array
) -> list[Panel]:
    edges = np.asarray(case.graph.edges)
    mask = np.asarray(case.graph.mask)
    false = edges[case.false & mask]
    panels = []
    for row in rows:
        if row["method"] in DRAWN:
            T = np.asarray(align_poses(row["T"], T_clean, "best"))
            title = f"{DRAWN[row['method']]}, {row['e_t mean']:.2g} m off"
            shown = false if row["method"] == "odometry" else false[:0]
            panels.append(Panel(title, T, shown))
    label = f"{name}, {len(false)} false closures ({share:.0%})"
    panels.append(Panel("clean optimum", np.asarray(T_clean), false[:0]))
    return [panels[0]._replace(label=label), *panels[1:]]


def main() -> None:
    """Prints the tables and draws the trajectories."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("JAXREG_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--shares", type=float, nargs="+", default=[0, 0.1, 0.3])
    parser.add_argument("--graphs", nargs="+", default=["parking-garage", "intel"])
    options = parser.parse_args()
    print(f"{cpu_model()}, {num_cores()} cores, {versions('jax', 'jaxlib')}, float64")
    rows, lines = [], []
    for name in options.graphs:
        path = options.data / "pose_graphs" / f"{name}.g2o"
        if not path.exists():
            print(f"{name}: no data: {path}")
            continue
        found, panels = study(name, path, options.shares, options.seeds)
        rows += found
        lines.append(panels)
    if options.out is None or not lines:
        return
    options.out.mkdir(parents=True, exist_ok=True)
    keep(rows, {"cpu": cpu_model()}, options.out / "rows.jsonl")
    for share in lines[0]:
        picture = options.out / f"trajectories_{100 * share:.0f}.png"
        trajectories_figure(picture, [panels[share] for panels in lines])
        print(f"picture: {picture}")


if __name__ == "__main__":
    main()
