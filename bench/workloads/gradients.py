"""What a gradient through a solution costs, beside the solution itself, in float64.

The loss is a weighted sum over the entries of the answer, with fixed random weights.
Its derivative in one direction of the input is held against what it must be: ICP's
answer follows a rigid motion of the source exactly, and correspondences do not change;
averaging is held against a central difference.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.records import error
from bench.workloads.local_data import draw, load
from jaxreg.averaging import Correntropy, MotionAveraging, average
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


def cases(options: Options) -> Iterator[Case]:
    """ICP with respect to the source, averaging with respect to the motions."""
    yield _icp()
    if options.quick:
        return
    X, edges, T, _ = random_graph(32, 465, 0.0, 0)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(T.shape)
    direction[:, 3] = 0
    for name, method in (
        ("MotionAveraging", MotionAveraging()),
        ("Correntropy", Correntropy()),
    ):

        def poses(x: jax.Array, method: Any = method) -> jax.Array:
            return average(PoseGraph.from_edges(edges, x, len(X)), method).T_world_i

        run, step = eqx.filter_jit(poses), 1e-5
        there, back = (
            np.asarray(run(jnp.asarray(T + s * step * direction))) for s in (1, -1)
        )
        slope = (there - back) / (2 * step)
        yield _case(f"{name}, 32 poses, by the motions", poses, T, direction, slope)


def _icp() -> Case:
    pair = draw(load(None), 500, 0)
    source, target = (x.astype(np.float64) for x in (pair.source, pair.target))

    def register(x: jax.Array | np.ndarray) -> jax.Array:
        near = jnp.asarray(pair.T_target_source)
        return jr.register(x, jnp.asarray(target), jr.ICP(), near).T_target_source

    # Of a twist of the source: the points move by it, the answer by its inverse.
    twist = np.zeros((4, 4))
    twist[:3] = [[0, -0.3, 0.2, 0.05], [0.3, 0, -0.5, 0.02], [-0.2, 0.5, 0, -0.03]]
    direction = source @ twist[:3, :3].T + twist[:3, 3]
    answer = np.asarray(eqx.filter_jit(register)(jnp.asarray(source)))
    slope = -answer @ twist
    return _case("ICP, 500 points, by the source", register, source, direction, slope)


def _case(
    name: str,
    answer: Callable[[jax.Array], jax.Array],
    x: np.ndarray,
    direction: np.ndarray,
    slope: np.ndarray,
) -> Case:
    weights = np.random.default_rng(1).standard_normal(slope.shape)
    forward = eqx.filter_jit(answer)
    gradient = eqx.filter_jit(jax.grad(lambda x: jnp.sum(weights * answer(x))))
    return Case(
        name=name,
        data="generated",
        methods=[
            Method("jaxreg, the answer", "jaxreg", "forward", partial(_call, forward)),
            Method("jaxreg, gradient", "jaxreg", "jax.grad", partial(_call, gradient)),
        ],
        trials=[(jnp.asarray(x),)],
        judge=partial(judge, direction, float(np.sum(weights * slope))),
        repeats=25,
        reference="jaxreg, the answer",
    )


def _call(fn: Callable[[jax.Array], jax.Array], x: jax.Array) -> np.ndarray:
    return np.asarray(fn(x))


def judge(direction: np.ndarray, slope: float, answers: list[Any]) -> Judged:
    """How far the derivative is off; nothing for the answer itself."""
    found = answers[0]
    if found.shape != direction.shape:
        return Judged([])
    gap = abs(float(np.sum(found * direction)) - slope) / abs(slope)
    return Judged([error("derivative off", 100 * gap, "%", 0.1)])
