"""Closest-point queries a second on one core, beside the k-d trees that users have.

Run: taskset -c 0 python -m bench.neighbours

Targets are points of the generated sculpture's scans; queries are other points of it,
near the surface (1 mm) and after a rotation of 10 degrees. Millions of queries a
second, best of seven after a warm-up; peers that are not installed are named. `excess`
is the mean distance that a voxel table's answer lies beyond the closest point, in
cells; `exact` the share of answers that are the closest point, near the surface.
Cells are exact within a sample spacing; 10 degrees off, where most queries are farther
away, their rate is that of approximate answers.
"""

import functools
import importlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxreg.datasets import sculpture_scans
from jaxreg.neighbours import AbstractIndex, BoxTree, BruteForce, CellGrid, VoxelTable
from jaxreg.neighbours.order import hilbert_order


NUM_QUERIES = 65536
TARGETS = (1_000, 10_000, 100_000)


def best_time(fn: Callable[[], Any], repeats: int = 7) -> float:
    """Least wall time of a call, after one that is not counted."""
    jax.block_until_ready(fn())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(fn())
        times.append(time.perf_counter() - start)
    return min(times)


def sculpture_points(num: int, seed: int) -> np.ndarray:
    """`(num, 3)` float32 points of the sculpture in one frame."""
    scans, T_world_i = sculpture_scans(12, seed=seed, points_per_scan=num // 10 + 100)
    moved = [s @ T[:3, :3].T + T[:3, 3] for s, T in zip(scans, T_world_i, strict=True)]
    rows = np.random.default_rng(seed).permutation(sum(map(len, moved)))[:num]
    return np.concatenate(moved)[rows].astype(np.float32)


def queries_off(target: np.ndarray, degrees: float) -> np.ndarray:
    """Points near the surface, turned about the vertical through the centre."""
    rng = np.random.default_rng(1)
    points = target[rng.integers(0, len(target), NUM_QUERIES)]
    points = points + 1e-3 * rng.standard_normal(points.shape)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    centre = target.mean(0)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return ((points - centre) @ turn.T + centre).astype(np.float32)


def own_rate(index: AbstractIndex, x: np.ndarray) -> float:
    """Millions of queries a second of an index, from coordinates as rows."""
    lookup = jax.jit(lambda index, columns: index.lookup(columns))
    columns = jnp.asarray(x.T)
    return x.shape[0] / best_time(lambda: lookup(index, columns)) / 1e6


def peers(target: np.ndarray) -> dict[str, Callable[[np.ndarray], Any] | str]:
    """Query functions of the peers, or why there is none."""
    found: dict[str, Callable[[np.ndarray], Any] | str] = {}
    tree = KDTree(target)
    found["SciPy KDTree"] = lambda x: tree.query(x)
    try:
        fast = importlib.import_module("pykdtree.kdtree").KDTree(target)
        found["pykdtree"] = lambda x: fast.query(x)
    except ImportError:
        found["pykdtree"] = "not installed"
    try:
        module = importlib.import_module("small_gicp")
        own = module.KdTree(target.astype(np.float64))
        found["small_gicp"] = lambda x: own.batch_nearest_neighbor_search(
            np.asarray(x, np.float64), 1
        )
    except ImportError:
        found["small_gicp"] = "not installed"
    return found


def table_row(target: np.ndarray, sets: list[np.ndarray], candidates: int) -> str:
    """Rates, build time and errors of a voxel table."""
    build = jax.jit(functools.partial(VoxelTable.build, candidates=candidates))
    points = jnp.asarray(target)
    seconds = best_time(lambda: build(points))
    table = build(points)
    rates = [own_rate(table, x) for x in sets]
    found = np.sqrt(np.asarray(table.query(jnp.asarray(sets[0])).sq_distance))
    excess = found - KDTree(target).query(sets[0])[0]
    return (
        f"  Table K = {candidates}   {rates[0]:8.2f} /{rates[1]:8.2f}   approximate, "
        f"excess {np.mean(excess) / float(table.cell):.3f} cells, "
        f"{np.mean(excess < 1e-6 * found):.0%} exact; build {1e3 * seconds:.0f} ms"
    )


def tree_rows(target: np.ndarray, sets: list[np.ndarray]) -> list[str]:
    """Rates of a box tree for sorted queries and as anyone calls it, and build time."""
    points = jnp.asarray(target)
    build = jax.jit(BoxTree.build)
    seconds = best_time(lambda: build(points))
    tree = build(points)
    query = jax.jit(lambda tree, x: tree.query(x))
    everyone = jnp.ones(NUM_QUERIES, bool)
    lookups, queries = [], []
    for x in map(jnp.asarray, sets):
        lookups.append(own_rate(tree, np.asarray(x[hilbert_order(x, everyone)])))
        queries.append(len(x) / best_time(functools.partial(query, tree, x)) / 1e6)
    return [
        f"  {name:13s} {rates[0]:8.2f} /{rates[1]:8.2f}   exact{note}"
        for name, rates, note in (
            ("Tree, lookup", lookups, f"; build {1e3 * seconds:.1f} ms"),
            ("Tree, query", queries, ", sorts"),
        )
    ]


def grid_row(target: np.ndarray, sets: list[np.ndarray]) -> str:
    """Rates of cells one sample spacing in radius, in order, and build time."""
    points = jnp.asarray(target)
    build = jax.jit(CellGrid.build)
    seconds = best_time(lambda: build(points))
    grid = build(points)
    everyone = jnp.ones(NUM_QUERIES, bool)
    ordered = [x[hilbert_order(jnp.asarray(x), everyone)] for x in sets]
    rates = [own_rate(grid, x) for x in ordered]
    found = grid.query(jnp.asarray(ordered[0]))
    true = KDTree(target).query(ordered[0])[0]
    near = np.asarray(found.valid)
    exact = np.sqrt(np.asarray(found.sq_distance))[near] < true[near] * (1 + 1e-5)
    return (
        f"  Cells         {rates[0]:8.2f} /{rates[1]:8.2f}   "
        f"{near.mean():.1%} within the radius, {exact.mean():.1%} of them exact; "
        f"build {1e3 * seconds:.1f} ms"
    )


def main() -> None:
    """Prints a table."""
    for num in TARGETS:
        target = sculpture_points(num, seed=0)
        sets = [queries_off(target, angle) for angle in (0, 10)]
        print(f"{num} targets; M queries/s near the surface / 10 degrees off")
        for candidates in (1, 8):
            print(table_row(target, sets, candidates))
        print(grid_row(target, sets))
        print(*tree_rows(target, sets), sep="\n")
        few = [x[:8192] for x in sets] if num > 1_000 else sets
        if num <= 10_000:
            brute = BruteForce.build(jnp.asarray(target))
            rates = [own_rate(brute, x) for x in few]
            print(f"  BruteForce    {rates[0]:8.2f} /{rates[1]:8.2f}   exact")
        for name, query in peers(target).items():
            if isinstance(query, str):
                print(f"  {name:13s} {query}")
                continue
            rates = [
                len(x) / best_time(lambda q=query, x=x: q(x), 5) / 1e6 for x in sets
            ]
            print(f"  {name:13s} {rates[0]:8.2f} /{rates[1]:8.2f}   exact")


if __name__ == "__main__":
    main()
