"""Many small graphs in one call, and single ones."""

import atexit
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import SIGMAS, robust, robust_many
from bench.records import error, share
from bench.workloads.averaging_data import H, N, batch_of, small_graph
from bench.workloads.local_pairs import written_out
from jaxreg._core.cores import num_cores
from jaxreg.averaging import Correntropy, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors


GRAPHS, FEWER, SINGLE = 1_000, 200, 20
PEER = "GTSAM Huber, Geman-McClure"
TOLD = f"from a breadth-first tree, deviations {SIGMAS[0]:g} degrees, {SIGMAS[1]:g}"


def cases(options: Options) -> Iterator[Case]:
    """Batches, in turn and side by side, and graphs in a call of their own."""
    rng = np.random.default_rng(0)
    drawn = [small_graph(rng) for _ in range(GRAPHS)]
    X, edges, T = (np.stack(x) for x in zip(*drawn, strict=True))
    graphs = batch_of(edges, T)
    cores = num_cores()
    peer = f"{PEER}, {cores} processes"
    solve = partial(_in_processes, _pool(cores), cores, edges, T)
    yield _batch(
        GRAPHS,
        [
            _own("jaxreg lax.map, one device", _in_turn, graphs),
            _own(f"jaxreg shard_map, {cores} devices", _on_devices(), graphs),
            Method(peer, "gtsam", TOLD, solve, in_processes=True),
        ],
        X,
        peer,
    )
    fewer = jax.tree.map(lambda x: x[:FEWER], graphs)
    one = "jaxreg lax.map, one device"
    yield _batch(
        FEWER,
        [_own(one, _in_turn, fewer), _own("jaxreg vmap, one device", _aside, fewer)],
        X[:FEWER],
        one,
    )
    yield _single(drawn[:SINGLE])


def _batch(num: int, methods: list[Method], X: np.ndarray, reference: str) -> Case:
    return Case(
        name=f"{num} graphs in one call",
        data=f"generated graphs of {N} poses and {H} edges, 30 % wrong",
        methods=methods,
        trials=[()],
        judge=lambda answers: judge(X, answers[0]),
        repeats=5,
        reference=reference,
        items=num,
        item="graphs",
    )


def _single(drawn: list[tuple[np.ndarray, ...]]) -> Case:
    inside = jax.jit(lambda graph: average(graph).T_world_i)
    text = written_out(Correntropy())
    return Case(
        name="one graph",
        data=f"generated graphs of {N} poses and {H} edges, 30 % wrong",
        methods=[
            Method("jaxreg average", "jaxreg", text,
                   lambda graph, *_: np.asarray(average(graph).T_world_i)),
            Method("jaxreg average inside a jit", "jaxreg", text,
                   lambda graph, *_: np.asarray(inside(graph))),
            Method(PEER, "gtsam", TOLD, _gtsam),
        ],
        trials=[
            (PoseGraph.from_edges(edges, T.astype(np.float32), N), edges, T)
            for _, edges, T in drawn
        ],
        judge=partial(judge, np.stack([X for X, *_ in drawn])),
        repeats=5,
        reference=PEER,
    )  # fmt: skip


def _own(name: str, many: Callable, graphs: PoseGraph) -> Method:
    solve = lambda: np.asarray(many(graphs))  # noqa: E731
    return Method(name, "jaxreg", written_out(Correntropy()), solve)


def _poses(graph: PoseGraph) -> jax.Array:
    return average(graph).T_world_i


_in_turn = jax.jit(partial(jax.lax.map, _poses))
_aside = jax.jit(jax.vmap(_poses))


def _on_devices() -> Callable[[PoseGraph], jax.Array]:
    """One graph after the other, on each device of the CPU its share."""
    over = jax.sharding.PartitionSpec("graph")
    kind = (jax.sharding.AxisType.Auto,)
    devices = jax.devices("cpu")
    mesh = jax.make_mesh((len(devices),), ("graph",), axis_types=kind, devices=devices)
    each = partial(jax.lax.map, _poses)
    return jax.jit(
        jax.shard_map(each, mesh=mesh, in_specs=over, out_specs=over, check_vma=False)
    )


def _pool(cores: int) -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(cores, mp_context=get_context("spawn"))
    atexit.register(pool.shutdown)
    return pool


def _in_processes(
    pool: ProcessPoolExecutor, cores: int, edges: np.ndarray, T: np.ndarray
) -> np.ndarray:
    tasks = [("Huber", edges[at::cores], T[at::cores], N) for at in range(cores)]
    poses = np.empty((len(T), N, 4, 4))
    for at, found in enumerate(pool.map(robust_many, tasks)):
        poses[at::cores] = found
    return poses


def _gtsam(_: PoseGraph, edges: np.ndarray, T: np.ndarray) -> np.ndarray:
    return robust(edges, T, N, kernel="Huber").T_world_i


def judge(X: np.ndarray, answers: Any) -> Judged:
    """Success as in the workload of outliers; the median of the errors."""
    found, true = jnp.asarray(answers, jnp.float32), jnp.asarray(X, jnp.float32)
    turn = jax.vmap(lambda a, b: jnp.mean(rotation_errors(a, b, "best")))(found, true)
    away = jax.vmap(lambda a, b: jnp.mean(translation_errors(a, b, "best")))
    e_R, e_t = np.rad2deg(turn), np.asarray(away(found, true))
    return Judged(
        [
            share("success", (e_R < 5) & (e_t < 0.05), 1.0),
            error("e_rot", float(np.median(e_R)), "deg", 0.005),
            error("e_trans", 100 * float(np.median(e_t)), "% of size", 0.005),
        ]
    )
