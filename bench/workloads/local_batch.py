"""Many pairs at once on all cores: one `register` of a batch beside its peers."""

import atexit
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np

from bench.case import Case, Method, Options
from bench.peers.local_settings import peers, solve_many
from bench.workloads.local_data import accuracy, draw, load
from bench.workloads.local_pairs import own_methods, pose_alone
from jaxreg._core.cores import num_cores


PAIRS, POINTS = 64, 2_000
#: Peers that come near in accuracy.
NAMES = ("small_gicp PLANE", "small_gicp GICP", "small_gicp GICP voxel 0.01",
         "Open3D plane 2-stage")  # fmt: skip


def cases(options: Options) -> Iterator[Case]:
    """One case of five calls."""
    shape = load(options.data)
    pairs = [draw(shape, POINTS, seed) for seed in range(PAIRS)]
    both = [(p.source, p.target) for p in pairs]
    sources, targets = (np.stack(x) for x in zip(*both, strict=True))
    cores = num_cores()
    methods = []
    for method in own_methods():
        assert method.solve is not None
        solve = partial(method.solve, sources, targets, 0.0)
        name = f"{method.name}, one batch"
        methods.append(
            Method(name, "jaxreg", method.parameters, solve, on_accelerator=True)
        )
    methods.append(_poses_alone(cores, sources, targets))
    pool = ProcessPoolExecutor(cores, mp_context=get_context("spawn"))
    atexit.register(pool.shutdown)
    for peer, *_ in peers():
        if peer.name not in NAMES:
            continue
        many = partial(_in_processes, pool, cores, peer.name, both, shape.extent)
        name = f"{peer.name}, {cores} processes"
        methods.append(
            Method(name, peer.library, peer.parameters, many, in_processes=True)
        )
        if peer.library == "small_gicp":
            assert peer.solve is not None
            threaded = partial(peer.solve, threads=cores)
            each = partial(_one_by_one, threaded, both, shape.extent)
            name = f"{peer.name}, {cores} threads"
            methods.append(Method(name, peer.library, peer.parameters, each))
    yield Case(
        name=f"{PAIRS} pairs of {POINTS} points",
        data=shape.name,
        methods=methods,
        trials=[()],
        judge=lambda answers: accuracy(list(answers[0]), pairs, shape.extent),
        repeats=7,
        reference=f"small_gicp GICP, {cores} processes",
        items=PAIRS,
        item="pairs",
    )


def _poses_alone(cores: int, sources: np.ndarray, targets: np.ndarray) -> Method:
    """A `jit` of the caller's that keeps the poses, which is what peers tell.

    A thread of the caller's for each core: in a `jit` a batch goes through one core.
    """
    alone = pose_alone()
    threads = ThreadPoolExecutor(cores)
    atexit.register(threads.shutdown)

    def some(at: int) -> np.ndarray:
        assert alone.solve is not None
        return alone.solve(sources[at::cores], targets[at::cores], 0.0)

    def every() -> np.ndarray:
        poses = np.empty((len(sources), 4, 4))
        for at, found in enumerate(threads.map(some, range(cores))):
            poses[at::cores] = found
        return poses

    name = f"{alone.name}, {cores} threads"
    return Method(name, alone.library, alone.parameters, every)


def _in_processes(
    pool: ProcessPoolExecutor,
    cores: int,
    name: str,
    both: list[tuple[np.ndarray, np.ndarray]],
    extent: float,
) -> np.ndarray:
    tasks = [(name, both[at::cores], extent) for at in range(cores)]
    poses = np.empty((len(both), 4, 4))
    for at, found in enumerate(pool.map(solve_many, tasks)):
        poses[at::cores] = found
    return poses


def _one_by_one(
    solve: Callable, both: list[tuple[np.ndarray, np.ndarray]], extent: float
) -> np.ndarray:
    return np.stack([solve(s, t, extent) for s, t in both])
