"""Throughput of batches: on the CPU, and on an accelerator where there is one.

Methods take a second row on the accelerator (see `bench.worker`). What bounds a method
is counted and told with it, so that its rate can be held against the device's figures.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.records import Metric
from bench.workloads.averaging_batch import judge as judge_averaged
from bench.workloads.averaging_data import H, N, batch_of, small_graph
from bench.workloads.filter_data import horse, horse_model, horse_name
from bench.workloads.filter_methods import look_ups
from bench.workloads.global_horse import judge as judge_horse
from bench.workloads.local_pairs import written_out
from bench.workloads.neighbours import queries_off, sculpture_points
from bench.workloads.prepared_model import ours
from jaxreg import register
from jaxreg.averaging import average
from jaxreg.neighbours import BruteForce


HORSES, GRAPHS, TARGETS, QUERIES = 200, 64, 10_000, 16_384


def cases(options: Options) -> Iterator[Case]:
    """Pairs, particles, closest points and graphs a second."""
    yield _horses(options)
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
