"""Throughput of batches: on the CPU, and on an accelerator where there is one.

Methods take a second row on the accelerator (see `bench.worker`). What bounds a method
is counted and told with it, so that its rate can be held against the device's figures.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.global_pairs import Features
from bench.records import Metric, share
from bench.workloads.averaging_batch import judge as judge_averaged
from bench.workloads.averaging_data import H, N, batch_of, small_graph
from bench.workloads.filter_data import horse, horse_model, horse_name
from bench.workloads.filter_methods import look_ups
from bench.workloads.global_horse import judge as judge_horse
from bench.workloads.global_scans import BELIEVED
from bench.workloads.local_pairs import written_out
from bench.workloads.neighbours import queries_off, sculpture_points
from bench.workloads.prepared_model import ours
from bench.workloads.sensor_data import Answer, SensorPair, sensor_pairs
from jaxreg import ParticleFilter, Status, register
from jaxreg.averaging import average
from jaxreg.neighbours import BruteForce


HORSES, GRAPHS, TARGETS, QUERIES = 200, 64, 10_000, 16_384
POINTS = 16_384  # of each scan
_ENDS = "source", "target"


def cases(options: Options) -> Iterator[Case]:
    """Pairs, particles, closest points and graphs a second."""
    yield _horses(options)
    if pairs := [p for p in sensor_pairs(options.data) if _fits(p)]:
        yield _scans(pairs)
    yield _closest()
    yield _graphs()


def _case(name: str, data: str, method: Method, items: int, item: str, judge) -> Case:  # noqa: ANN001
    return Case(
        name=name,
        data=data,
        methods=[method],
        trials=[()],
        judge=judge,
        repeats=5,
        items=items,
        item=item,
    )


def _horses(options: Options) -> Case:
    folder = options.data / "horse"
    trials = horse(HORSES, 0.25, horse_model(folder))
    target = np.broadcast_to(trials.target, (HORSES, *trials.target.shape))

    def solve() -> np.ndarray:
        found = register(trials.source, target, ours(), key=jax.random.key(0))
        return np.asarray(found.T_target_source, float)

    each = look_ups(ours(), trials)
    text = f"{written_out(ours())}; {each} closest points a pair at most"
    method = Method("jaxreg register", "jaxreg", text, solve, on_accelerator=True)
    name = f"{HORSES} horses in one call, 25 % noise"
    return _case(
        name,
        horse_name(folder),
        method,
        HORSES,
        "pairs",
        lambda x: judge_horse(trials, list(x[0])),
    )


def _fits(pair: SensorPair) -> bool:
    return min(len(pair.source), len(pair.target)) >= POINTS


def _scans(pairs: list[SensorPair]) -> Case:
    """Scans of sensors, thinned at random to one size."""
    rng = np.random.default_rng(0)

    def some(points: np.ndarray) -> np.ndarray:
        return points[rng.choice(len(points), POINTS, replace=False)]

    thinned = [p._replace(source=some(p.source), target=some(p.target)) for p in pairs]
    source, target = (np.stack([getattr(p, end) for p in thinned]) for end in _ENDS)

    def solve() -> list[Answer]:
        found = register(source, target, key=jax.random.key(0))
        T = np.asarray(found.T_target_source, float)
        believed = np.asarray(found.status) == Status.CONVERGED
        return [Answer(T[k], bool(believed[k])) for k in range(len(T))]

    def by_features() -> list[Answer]:
        return [_by_open3d(pair) for pair in thinned]

    text = written_out(ParticleFilter())
    own = Method("jaxreg register", "jaxreg", text, solve, on_accelerator=True)
    peer = Method("Open3D RANSAC, FPFH", "open3d", "voxels of the data", by_features)
    name = f"{len(pairs)} pairs of scans, {POINTS} points, in one call"
    case = _case(
        name, "sensor_pairs", own, len(pairs), "pairs", lambda x: _judge(thinned, x[0])
    )
    return replace(case, methods=[own, peer])


def _by_open3d(pair: SensorPair) -> Answer:
    peer = Features("RANSAC", pair.voxel, camera_at_origin=pair.camera_at_origin)
    T, score = peer.solve(peer.prepare(pair.source), peer.prepare(pair.target), 0)
    return Answer(T, score > BELIEVED)


def _judge(pairs: list[SensorPair], answers: list[Answer]) -> Judged:
    both = list(zip(pairs, answers, strict=True))
    right = np.array([pair.right(a.T_target_source) for pair, a in both])
    believed = np.array([a.believed for a in answers])
    wrong = float(np.sum(believed & ~right))
    return Judged(
        [
            share("right", right, 1.0),
            share("right and believed", right & believed, 1.0),
            Metric("wrong and believed", wrong, "", "down", 0.0),
        ]
    )


def _closest() -> Case:
    target = sculpture_points(TARGETS, seed=0)
    columns = queries_off(target, 10, QUERIES).T
    look = jax.jit(lambda index, x: index.lookup(x))

    def solve() -> np.ndarray:
        index = BruteForce.build(jnp.asarray(target))
        return np.asarray(look(index, jnp.asarray(columns)))

    work = 8 * TARGETS * QUERIES / 1e9
    text = f"brute force; {work:.2f} billion operations a call"
    method = Method("jaxreg BruteForce", "jaxreg", text, solve, on_accelerator=True)
    name = f"{QUERIES} closest of {TARGETS}"
    truth = solve()
    return _case(
        name, "generated sculpture", method, QUERIES, "queries", partial(_same, truth)
    )


def _same(truth: np.ndarray, answers: list[Any]) -> Judged:
    same = 100 * float(np.mean(answers[0] == truth))
    return Judged([Metric("same as on the CPU", same, "%", "up", 1.0)])


def _graphs() -> Case:
    rng = np.random.default_rng(0)
    drawn = [small_graph(rng) for _ in range(GRAPHS)]
    X, edges, T = (np.stack(x) for x in zip(*drawn, strict=True))
    many = jax.jit(lambda g: jax.lax.map(average, g))

    def solve() -> np.ndarray:
        return np.asarray(many(batch_of(edges, T)).T_world_i)

    method = Method("jaxreg average", "jaxreg", "lax.map", solve, on_accelerator=True)
    name = f"{GRAPHS} graphs of {N} poses, {H} edges, 30 % wrong"
    return _case(
        name,
        "generated graphs",
        method,
        GRAPHS,
        "graphs",
        lambda x: judge_averaged(X, x[0]),
    )
