"""Our own steps beside the solvers of optimistix and lineax, in the same methods."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import lineax
import numpy as np
import optimistix

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.records import Metric, error
from bench.workloads.local_data import Draw, accuracy, draw, load
from tests.averaging.graphs import random_graph


#: By the tolerances that optimistix shows in its own examples.
SOLVERS: dict[str, Callable[[float, float], Any]] = {
    "Gauss-Newton": optimistix.GaussNewton,
    "LM": optimistix.LevenbergMarquardt,
    "Dogleg": optimistix.Dogleg,
    "BFGS": optimistix.BFGS,
}
_NUM_POINTS, _NUM_PAIRS = 2_000, 6
# A dense factor of 600 unknowns, as the solvers take, is a fifth of a second.
_NUM_POSES, _NUM_EDGES = 200, 600


def cases(options: Options) -> Iterator[Case]:
    """Pairs of clouds, two clouds as a whole, and a graph."""
    yield _icp(options.data)
    yield _correlation(options.data)
    yield _graph()


def _icp(data: Path) -> Case:
    steps: dict[str, jr.AbstractStep] = {
        "jaxreg Gauss-Newton": jr.GaussNewton(),
        "jaxreg LM": jr.LevenbergMarquardt(),
    }
    for name, solver in SOLVERS.items():
        steps[f"optimistix {name}"] = jr.OptimistixStep(solver(1e-4, 1e-4))
    methods = {name: jr.ICP(step=step) for name, step in steps.items()}
    return _pairs("ICP", data, _NUM_POINTS, methods)


def _correlation(data: Path) -> Case:
    methods: dict[str, jr.AbstractRegistrar] = {"jaxreg Newton": jr.KernelCorrelation()}
    for name, solver in SOLVERS.items():
        method = jr.KernelCorrelation(solver=solver(1e-4, 1e-4))
        methods[f"optimistix {name}"] = method
    return _pairs("KernelCorrelation", data, 500, methods)


def _pairs(name: str, data: Path, num: int, methods: dict[str, Any]) -> Case:
    shape = load(data)
    pairs = [draw(shape, num, seed) for seed in range(_NUM_PAIRS)]
    return Case(
        name=f"{name}, {num} points",
        data=shape.name,
        methods=[
            Method(k, "jaxreg", repr(m), partial(_register, m))
            for k, m in methods.items()
        ],
        trials=[(p.source, p.target) for p in pairs],
        judge=partial(_judge_pairs, pairs, shape.extent),
        repeats=3,
        reference=next(iter(methods)),
    )


def _register(
    method: Any, source: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, int]:
    sol = jr.register(source, target, method, np.eye(4, dtype=np.float32))
    return np.asarray(sol.T_target_source), int(sol.num_steps)


def _judge_pairs(pairs: list[Draw], extent: float, answers: list[Any]) -> Judged:
    judged = accuracy([T for T, _ in answers], pairs, extent)
    steps = Metric("steps", float(np.median([n for _, n in answers])), "", "down")
    return Judged([*judged.metrics, steps], judged.samples)


def _graph() -> Case:
    _, edges, T, _ = random_graph(_NUM_POSES, _NUM_EDGES, 0.0, 0, d=2)
    graph = jr.PoseGraph.from_edges(edges, T, _NUM_POSES)
    ours = jr.PoseGraphLM()
    methods = {"jaxreg LM": ours}
    for name, linear in (("Cholesky", lineax.Cholesky()), ("CG", lineax.CG(1e-2, 0.0))):
        method = dataclasses.replace(ours, linear_solver=linear)
        methods[f"jaxreg LM, lineax {name}"] = method
    for name, solver in SOLVERS.items():
        # BFGS needs several steps for each of the unknowns.
        method = dataclasses.replace(ours, solver=solver(1e-6, 1e-6), max_steps=500)
        methods[f"optimistix {name}"] = method
    # A program of its own: the first call of ours compiles, as those of the others.
    exact = dataclasses.replace(ours, tolerance=1e-15, max_steps=100)
    minimum = np.asarray(jr.average(graph, exact).T_world_i)
    return Case(
        name=f"PoseGraphLM, {_NUM_POSES} poses, {_NUM_EDGES} edges",
        data="generated",
        methods=[
            Method(k, "jaxreg", repr(m), partial(_average, m, graph))
            for k, m in methods.items()
        ],
        trials=[()],
        judge=partial(_judge_graph, minimum),
        repeats=3,
        long=True,
        reference="jaxreg LM",
    )


def _average(method: jr.PoseGraphLM, graph: jr.PoseGraph) -> tuple[np.ndarray, int]:
    sol = jr.average(graph, method)
    return np.asarray(sol.T_world_i), int(sol.num_steps)


def _judge_graph(minimum: np.ndarray, answers: list[Any]) -> Judged:
    """How far the poses are from the minimum, that of many more steps of ours."""
    T, steps = answers[0]
    off = float(np.max(np.abs(T - minimum)))
    return Judged(
        [error("off", off, "", 1e-4), Metric("steps", float(steps), "", "down")]
    )
