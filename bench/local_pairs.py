"""Local registration of one pair beside its peers, from raw points to pose.

Run: taskset -c 0 python -m bench.local_pairs [--data DIR] [--json FILE]
     taskset -c 0,1 python -m bench.local_pairs --batch [--data DIR]

Source and target are disjoint random subsets of the Stanford Bunny's ten scans, pooled
by their true poses; the source is turned by 10 degrees about a random axis through its
centroid and moved by 5 % of the extent (the diagonal of the bounding box). All methods
solve the same draws from the identity, take the same float32 points, and are called in
turn within a draw, in an order that changes. What is counted runs from NumPy points to
a NumPy pose: conversion, normals, covariances and trees included. Times are medians
over draws and repeats with the quartiles, after a first call of each method on each
size, which is given apart (with compilation for jaxreg). CPU time is that of all
threads. Errors: rotation in degrees; distance between the source's centroid where it
was put and where it belongs, in % of the extent. A success is below 1 degree and 1 %.
Settings of the peers are the best found for this task and printed; rows named voxel
thin the clouds first. Without the Bunny in DIR (else JAXREG_DATA, else
../shared/data) the generated sculpture is used and named.

With --batch: pairs a second of one `register` on a batch of pairs, and of the peers
with as many threads or processes as there are cores.
"""

import argparse
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any


# Read by the libraries when they load; the number of cores is the process's affinity.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import jax  # noqa: E402
import numpy as np  # noqa: E402

import jaxreg as jr  # noqa: E402
from bench import timing  # noqa: E402
from bench.local_data import Draw, Shape, accuracy, draw, load  # noqa: E402
from bench.peers_local import Method, peers, small_gicp, solve_many  # noqa: E402


DRAWS = {500: 20, 2_000: 12, 10_000: 6, 100_000: 3}
PACKAGES = ("jax", "numpy", "scipy", "small_gicp", "open3d")
BATCH, BATCH_POINTS = 64, 2_000
SLACK = 1.1  # errors up to this ratio count as equal


def own_solve(method: Any, source: np.ndarray, target: np.ndarray, _: float):
    """`register` from the identity, as a user calls it."""
    solution = jr.register(source, target, method, np.eye(4, dtype=np.float32))
    return np.asarray(solution.T_target_source)


def written_out(part: Any) -> str:
    """A method object with all its settings, on one line."""
    if isinstance(part, type):
        return part.__name__
    if not dataclasses.is_dataclass(part):
        return f"{part:.3g}" if isinstance(part, jax.Array) else str(part)
    settings = [
        f"{field.name}={written_out(getattr(part, field.name))}"
        for field in dataclasses.fields(part)
    ]
    return f"{type(part).__name__}({', '.join(settings)})"


def own_methods() -> list[Method]:
    """The rows of this package."""
    methods = {"jaxreg ICP": jr.ICP()}
    return [
        Method(name, written_out(method), partial(own_solve, method))
        for name, method in methods.items()
    ]


def run_size(
    shape: Shape, methods: list[Method], num: int, draws: int, repeats: int
) -> list[dict]:
    """A row per method: all of them in turn on each draw."""
    pairs = [draw(shape, num, seed) for seed in range(draws)]
    cases = [(p.source, p.target, shape.extent) for p in pairs]
    chosen = [m for m in methods if m.smallest <= num]
    solves = {m.name: m.solve for m in chosen if m.solve is not None}
    first, calls, failed = timing.in_turn(solves, cases, repeats)
    rows = []
    for name, note, *_ in chosen:
        row: dict = {"name": name, "parameters": note, "points": num, "draws": draws}
        if name not in calls:
            rows.append(row | {"failed": failed.get(name, note)})
            continue
        every = [call for of_draw in calls[name] for call in of_draw]
        cpu = timing.quartiles([call.cpu for call in every], 1e3)
        wall = timing.quartiles([call.wall for call in every], 1e3)
        row |= {
            "cpu_ms": cpu[1],
            "cpu_ms_quartiles": [cpu[0], cpu[2]],
            "wall_ms": wall[1],
            "wall_ms_quartiles": [wall[0], wall[2]],
            "first_call_s": first[name].wall,
            "calls": len(every),
        }
        found = [of_draw[-1].value for of_draw in calls[name]]
        rows.append(row | accuracy(found, pairs, shape.extent))
    return rows


def as_accurate(row: dict, other: dict) -> bool:
    """Whether a row errs no more than another, and succeeds as often."""
    return (
        row["e_rot_deg"] <= SLACK * other["e_rot_deg"]
        and row["e_trans_percent"] <= SLACK * other["e_trans_percent"]
        and row["success"] >= other["success"]
    )


def verdict(rows: list[dict]) -> Iterator[str]:
    """The peers nobody beats in both time and accuracy, and what jaxreg is to them."""
    good = [r for r in rows if "failed" not in r]
    rivals = sorted(
        (r for r in good if not r["name"].startswith("jaxreg")),
        key=lambda r: r["cpu_ms"],
    )
    front = [
        r
        for at, r in enumerate(rivals)
        if not any(as_accurate(quicker, r) for quicker in rivals[:at])
    ]
    for r in front:
        yield (
            f"  no quicker peer is as accurate: {r['name']:32s} {r['cpu_ms']:9.2f} ms"
            f"  {r['e_rot_deg']:.3f} deg  {r['e_trans_percent']:.3f} %"
        )
    for own in good:
        if not own["name"].startswith("jaxreg"):
            continue
        equals = [r for r in rivals if as_accurate(r, own)]
        beaten = [r for r in rivals if as_accurate(own, r)]
        if equals:
            ratio = own["cpu_ms"] / equals[0]["cpu_ms"]
            yield (
                f"  {own['name']}: {ratio:.2f} x the CPU time of the quickest peer "
                f"that is as accurate, {equals[0]['name']}"
            )
        else:
            yield f"  {own['name']}: no peer is as accurate"
        if beaten:
            ratio = own["cpu_ms"] / beaten[0]["cpu_ms"]
            yield (
                f"  {own['name']}: {ratio:.2f} x the CPU time of the quickest peer "
                f"that it is as accurate as, {beaten[0]['name']}"
            )


def table(rows: list[dict]) -> None:
    """Prints the rows of one size."""
    print(
        f"{rows[0]['points']} points   {'CPU ms':>22} {'quartiles':>19} {'wall ms':>9}"
        f" {'deg':>7} {'max':>7} {'%':>7} {'max':>7} {'ok':>5} {'first s':>8}"
    )
    for r in rows:
        if "failed" in r:
            print(f"  {r['name']:31s} {r['failed']}")
            continue
        low, high = r["cpu_ms_quartiles"]
        print(
            f"  {r['name']:31s}{r['cpu_ms']:9.2f} {low:9.2f}-{high:9.2f} "
            f"{r['wall_ms']:9.2f} {r['e_rot_deg']:7.3f} {r['e_rot_deg_max']:7.3f} "
            f"{r['e_trans_percent']:7.3f} {r['e_trans_percent_max']:7.3f} "
            f"{r['success']:5.0%} {r['first_call_s']:8.2f}"
        )
    print("\n".join(verdict(rows)), flush=True)


def batch_calls(
    shape: Shape, pairs: list[Draw], names: list[str], pool: ProcessPoolExecutor
) -> dict[str, Callable[[], np.ndarray]]:
    """What solves all pairs, on all cores: poses `(64, 4, 4)`."""
    cores = timing.num_cores()
    both = [(p.source, p.target) for p in pairs]
    sources, targets = (np.stack(x) for x in zip(*both, strict=True))
    calls: dict[str, Callable[[], np.ndarray]] = {}
    for method in own_methods():
        solve = method.solve
        assert solve is not None
        if any(x in method.name for x in names):
            calls[f"{method.name}, one batch"] = partial(solve, sources, targets, 0.0)

    def in_processes(name: str) -> np.ndarray:
        parts = [both[at::cores] for at in range(cores)]
        tasks = [(name, part, shape.extent) for part in parts]
        poses = np.empty((len(both), 4, 4))
        for at, found in enumerate(pool.map(solve_many, tasks)):
            poses[at::cores] = found
        return poses

    for peer in peers():
        fits = peer.smallest <= BATCH_POINTS and any(x in peer.name for x in names)
        if peer.solve is None or not fits:
            continue
        calls[f"{peer.name}, {cores} processes"] = partial(in_processes, peer.name)
        if isinstance(peer.solve, partial) and peer.solve.func is small_gicp:
            threaded = partial(peer.solve, threads=cores)
            calls[f"{peer.name}, {cores} threads"] = lambda f=threaded: np.stack(
                [f(s, t, shape.extent) for s, t in both]
            )
    return calls


def run_batch(shape: Shape, names: list[str], repeats: int) -> list[dict]:
    """Pairs a second, by wall time: the median and the best of the repeats."""
    pairs = [draw(shape, BATCH_POINTS, seed) for seed in range(BATCH)]
    rows: list[dict] = [
        {"name": peer.name, "failed": peer.parameters}
        for peer in peers()
        if peer.solve is None and any(x in peer.name for x in names)
    ]
    with ProcessPoolExecutor(
        timing.num_cores(), mp_context=get_context("spawn")
    ) as pool:
        calls = batch_calls(shape, pairs, names, pool)
        first, timed, failed = timing.in_turn(calls, [()], repeats)
    rows += [{"name": name, "failed": why} for name, why in failed.items()]
    walls = {name: [call.wall for call in timed[name][0]] for name in timed}
    for name in walls:
        row = {
            "name": name,
            "pairs": BATCH,
            "points": BATCH_POINTS,
            "pairs_per_s": BATCH / float(np.median(walls[name])),
            "pairs_per_s_best": BATCH / min(walls[name]),
            "first_call_s": first[name].wall,
        }
        rows.append(row | accuracy(first[name].value, pairs, shape.extent))
    return rows


def batch_table(rows: list[dict]) -> None:
    """Prints the throughput, and the ratio to the quickest peer as accurate."""
    print(
        f"{BATCH} pairs of {BATCH_POINTS} points {'pairs/s':>21} {'best':>8} "
        f"{'deg':>7} {'%':>7} {'ok':>5} {'first s':>8}"
    )
    for r in (r for r in rows if "failed" in r):
        print(f"  {r['name']:42s}{r['failed']}")
    rows = [r for r in rows if "failed" not in r]
    for r in rows:
        print(
            f"  {r['name']:42s}{r['pairs_per_s']:8.1f} {r['pairs_per_s_best']:8.1f} "
            f"{r['e_rot_deg']:7.3f} {r['e_trans_percent']:7.3f} {r['success']:5.0%} "
            f"{r['first_call_s']:8.2f}"
        )
    for own in (r for r in rows if r["name"].startswith("jaxreg")):
        rivals = [r for r in rows if not r["name"].startswith("jaxreg")]
        for text, some in (
            ("as accurate", [r for r in rivals if as_accurate(r, own)]),
            ("it is as accurate as", [r for r in rivals if as_accurate(own, r)]),
        ):
            if some:
                best = max(some, key=lambda r: r["pairs_per_s"])
                ratio = own["pairs_per_s"] / best["pairs_per_s"]
                print(
                    f"  {own['name']}: {ratio:.2f} x the pairs a second of the "
                    f"quickest peer {text}, {best['name']}"
                )


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    parser.add_argument("--data", type=Path, default=default)
    parser.add_argument("--json", type=Path, help="adds a line per row to this file")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(DRAWS))
    parser.add_argument("--draws", type=int, help="pairs per size")
    parser.add_argument("--repeats", type=int, default=3, help="calls per draw")
    parser.add_argument("--only", nargs="+", help="methods whose name contains one")
    parser.add_argument("--batch", action="store_true", help="throughput instead")
    return parser.parse_args()


def main() -> None:
    """Prints the tables."""
    options = parse()
    shape = load(options.data)
    machine = {
        "data": shape.name,
        "cores": timing.num_cores(),
        "cpu": timing.cpu_model(),
        "device": jax.devices()[0].device_kind,
        "versions": {"jaxreg": jr.__version__, **timing.versions(*PACKAGES)},
    }
    print(f"{shape.name}, {len(shape.points)} points, extent {shape.extent:.4g}")
    print(f"{machine['cores']} core(s) of {machine['cpu']}; {machine['versions']}")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        print("compilation cache on: first calls may find compiled code")
    if options.batch:
        names = options.only or ["jaxreg", "PLANE", "GICP", "plane"]
        rows = run_batch(shape, names, max(options.repeats, 5))
        batch_table(rows)
        timing.keep(rows, machine, options.json)
        return
    methods = own_methods() + peers()
    if options.only:
        methods = [m for m in methods if any(x in m.name for x in options.only)]
    if not methods:
        sys.exit(f"--only: no method has a name with any of {options.only}")
    for m in methods:
        print(f"  {m.name:31s} {m.parameters}")
    for num in options.sizes:
        draws = options.draws or DRAWS.get(num, 5)
        rows = run_size(shape, methods, num, draws, options.repeats)
        table(rows)
        timing.keep(rows, machine, options.json)


if __name__ == "__main__":
    main()
