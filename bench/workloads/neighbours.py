"""Closest points: the indices of jaxreg beside the trees that users have.

Where the queries are in space decides: near the surface, and after a turn of 10
degrees. Cells are exact within a sample spacing, voxel tables are approximate. Peers
take NumPy points and give NumPy distances. An index of jaxreg takes the same queries on
its device in the order of a Hilbert curve, as ICP keeps them, and gives rows, unless
its name says `query`: that takes and gives NumPy arrays and sorts by itself.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from bench.case import Case, Judged, Method, Options, Solve
from bench.peers.neighbours import TREES, Query
from bench.records import Metric
from jaxreg.datasets import sculpture_scans
from jaxreg.neighbours import BoxTree, BruteForce, CellGrid, VoxelTable
from jaxreg.neighbours.order import hilbert_order


QUERIES = 65_536
TARGETS = (1_000, 10_000, 100_000)
#: Slow ones get fewer queries: their rate does not depend on it.
FEW = 8_192


def cases(options: Options) -> Iterator[Case]:
    """A case per number of targets and turn of the queries."""
    for num in (10_000,) if options.quick else TARGETS:
        target = sculpture_points(num, seed=0)
        for turn in (10,) if options.quick else (0, 10):
            queries = queries_off(target, turn, FEW if options.quick else QUERIES)
            truth = np.asarray(KDTree(target).query(queries)[0])
            ordered = np.asarray(hilbert_order(jnp.asarray(queries), _all(queries)))
            yield Case(
                name=f"{num} targets, {turn} degrees off",
                data="generated sculpture",
                methods=[*own(target), *peers(target)],
                trials=[(queries, jnp.asarray(queries[ordered].T))],
                judge=partial(judge, target, queries, ordered, truth),
                repeats=25 if options.quick else 9,
                reference="SciPy KDTree",
                items=len(queries),
                item="queries",
                x=num,
                x_label=f"targets, {turn} degrees off",
            )


def _all(points: np.ndarray) -> jax.Array:
    return jnp.ones(len(points), bool)


def sculpture_points(num: int, seed: int) -> np.ndarray:
    """`(num, 3)` float32 points of the sculpture in one frame."""
    scans, T_world_i = sculpture_scans(12, seed=seed, points_per_scan=num // 10 + 100)
    moved = [s @ T[:3, :3].T + T[:3, 3] for s, T in zip(scans, T_world_i, strict=True)]
    rows = np.random.default_rng(seed).permutation(sum(map(len, moved)))[:num]
    return np.concatenate(moved)[rows].astype(np.float32)


def queries_off(target: np.ndarray, degrees: float, num: int) -> np.ndarray:
    """Points near the surface (1 mm), turned about the vertical through the centre."""
    rng = np.random.default_rng(1)
    points = target[rng.integers(0, len(target), num)]
    points = points + 1e-3 * rng.standard_normal(points.shape)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    centre = target.mean(0)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return ((points - centre) @ turn.T + centre).astype(np.float32)


def own(target: np.ndarray) -> list[Method]:
    """The indices; brute force up to 10,000 targets."""
    tables = [
        _looking(
            f"jaxreg VoxelTable, {k} candidate{'s' * (k > 1)}",
            f"candidates={k}; approximate",
            partial(VoxelTable.build, candidates=k),
            target,
        )
        for k in (1, 8)
    ]
    rest: dict[str, tuple[str, Callable]] = {
        "jaxreg CellGrid": ("exact within a spacing", CellGrid.build),
        "jaxreg BoxTree": ("defaults", BoxTree.build),
    }
    if len(target) <= 10_000:
        rest["jaxreg BruteForce"] = ("defaults", BruteForce.build)
    methods = [
        *tables,
        *(_looking(k, text, make, target) for k, (text, make) in rest.items()),
    ]
    sorting = partial(_sorting, target)
    return [
        *methods,
        Method("jaxreg BoxTree, query", "jaxreg", "sorts by itself", prepare=sorting),
    ]


def _looking(name: str, text: str, make: Callable, target: np.ndarray) -> Method:
    build = jax.jit(make)
    look = jax.jit(lambda index, columns: index.lookup(columns))

    def prepare() -> Solve:
        index = jax.block_until_ready(build(jnp.asarray(target)))
        return lambda _, columns: np.asarray(look(index, columns))

    return Method(name, "jaxreg", text, prepare=prepare)


def _sorting(target: np.ndarray) -> Solve:
    tree = jax.block_until_ready(jax.jit(BoxTree.build)(jnp.asarray(target)))
    query = jax.jit(lambda tree, x: tree.query(x))
    return lambda x, _: np.sqrt(np.asarray(query(tree, jnp.asarray(x)).sq_distance))


def peers(target: np.ndarray) -> list[Method]:
    """The trees of others."""
    text = "defaults, one neighbour"
    return [
        Method(name, library, text, prepare=partial(_by_peer, make, target))
        for (name, library), make in TREES.items()
    ]


def _by_peer(make: Callable[[np.ndarray], Query], target: np.ndarray) -> Solve:
    query = make(target)
    return lambda x, _: query(x)


def judge(
    target: np.ndarray,
    queries: np.ndarray,
    order: np.ndarray,
    truth: np.ndarray,
    answers: list[Any],
) -> Judged:
    """Share of queries whose answer, a distance or a row, is the closest point."""
    found = np.asarray(answers[0])
    if np.issubdtype(found.dtype, np.integer):
        found = np.linalg.norm(queries[order] - target[found], axis=1)
        truth = truth[order]
    exact = np.mean(found <= truth * (1 + 1e-4) + 1e-7)
    return Judged([Metric("exact", 100 * float(exact), "%", "up", 1.0)])
