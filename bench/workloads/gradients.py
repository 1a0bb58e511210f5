"""What a gradient through a solution costs, beside the solution itself, in float64.

The loss is a weighted sum over the entries of the answer, with fixed random weights.
Its derivative in one direction of the input is held against central differences, of
pairs so small that correspondences do not change.

Errors of a sensor move all points of both clouds: two noisy ones of 300 points, as a
rigid motion alone would prove nothing about normals, widths and spacings.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.peers import torch_gradients as peers
from bench.records import error
from bench.workloads.local_data import draw, load
from jaxreg.averaging import Correntropy, MotionAveraging, SpanningTree, average
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.registrar import AbstractRegistrar
from jaxreg.testing.problems import motion, move, surface
from tests.averaging.graphs import random_graph


def cases(options: Options) -> Iterator[Case]:
    """Pairs by points and by errors of a sensor, averaging by the motions."""
    yield _icp()
    if options.quick:
        return
    yield _pypose()
    yield from _sensed_pairs()
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

        programs = _programs(poses, X.shape)
        slope = _slope(programs[0], T, _FAR * direction) / _FAR
        yield _case(f"{name}, 32 poses, by the motions", programs, T, direction, slope)
    yield _theseus(edges, T, len(X))


#: What moves points, in the order of `_sensed`, and methods that are asked about all.
_CHANGES = (
    "source points",
    "target points",
    "range bias",
    "radial distortion",
    "scale of an axis",
    "scale of both",
)
_EYE = np.array([0.3, -3.0, 0.5])  # where the sensor stands
_METHODS: dict[str, AbstractRegistrar] = {
    "ICP": jr.ICP(tolerance=1e-13, max_steps=300),
    "ParticleFilter": jr.ParticleFilter(),
    "MultiStart": jr.MultiStart(),
    "KernelCorrelation": jr.KernelCorrelation(tolerance=1e-12),
}
_POINTS = jr.ICP()
# Half of the difference: larger ones exchange matches on clouds as noisy as these.
_STEP = 1e-7
_FAR = 1e-5  # that of motions


def _sensed(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two noisy clouds of a surface, a seventh of a radian apart, changed by x."""
    rng = np.random.default_rng(1)
    source = surface(300, 3, 1)
    noisy = source + 0.05 * rng.standard_normal(source.shape)
    target = move(motion(3, 0.15, 0.05, 1), noisy)
    moved = [
        points + x[k] * rng.standard_normal(points.shape)
        for k, points in enumerate((source, target))
    ]

    def seen(points: jax.Array) -> jax.Array:
        ray = points - _EYE
        length = jnp.linalg.norm(ray, axis=1, keepdims=True)
        points = _EYE + ray * (1 + x[2] / length + x[3] * length)
        return points * jnp.asarray([1, 1 + x[4], 1]) * (1 + x[5])

    return seen(jnp.asarray(moved[0])), seen(jnp.asarray(moved[1]))


def _sensed_pairs() -> Iterator[Case]:
    """A case for each change and method; a method's cases share their programs."""
    for name, method in _METHODS.items():

        def poses(x: jax.Array, method: AbstractRegistrar = method) -> jax.Array:
            key = jax.random.key(0)
            return jr.register(*_sensed(x), method, key=key).T_target_source

        through = None
        if isinstance(method, jr.ICP):
            through = partial(poses, method=_through_the_steps(method))
        programs = _programs(poses, (4, 4), through)
        for direction, what in zip(np.eye(len(_CHANGES)), _CHANGES, strict=True):
            x = np.zeros(len(_CHANGES))
            slope = _slope(programs[0], x, _STEP * direction) / _STEP
            yield _case(f"{name}, by {what}", programs, x, direction, slope)


def _turned_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Source, target, a start, and the change of the source by a twist, in float64."""
    pair = draw(load(None), 500, 0)
    source, target = (x.astype(np.float64) for x in (pair.source, pair.target))
    # Cells that normals are taken from keep the axes, so the answer follows by the
    # twist's inverse but for 0.3 %.
    twist = np.zeros((4, 4))
    twist[:3] = [[0, -0.3, 0.2, 0.05], [0.3, 0, -0.5, 0.02], [-0.2, 0.5, 0, -0.03]]
    direction = source @ twist[:3, :3].T + twist[:3, 3]
    return source, target, np.asarray(pair.T_target_source, np.float64), direction


def _icp() -> Case:
    source, target, start, direction = _turned_pair()

    def register(
        x: jax.Array | np.ndarray, method: AbstractRegistrar = _POINTS
    ) -> jax.Array:
        near = jnp.asarray(start)
        return jr.register(x, jnp.asarray(target), method, near).T_target_source

    through = partial(register, method=_through_the_steps(_POINTS))
    programs = _programs(register, (4, 4), through)
    slope = _slope(programs[0], source, _STEP * direction) / _STEP
    return _case("ICP, 500 points, by the source", programs, source, direction, slope)


def _slope(answer: Callable, x: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Half of the difference between the answers at both ends."""
    there, back = (np.asarray(answer(jnp.asarray(x + s * change))) for s in (1, -1))
    return (there - back) / 2


def _pypose() -> Case:
    source, target, start, direction = _turned_pair()
    build = cache(partial(peers.pypose_icp, target, start, _weights((4, 4))))
    built = {"PyPose": ("pypose", "module.ICP, each step kept", build)}
    return _torch_case("PyPose, 500 points, by the source", built, source, direction)


def _theseus(edges: np.ndarray, T: np.ndarray, num: int) -> Case:
    tree = average(PoseGraph.from_edges(edges, T, num), SpanningTree()).T_world_i
    start, weights = np.asarray(tree), _weights(tree.shape)
    # It differentiates along motions: no other change of a matrix is seen.
    turn = np.random.default_rng(0).standard_normal((len(T), 6))
    moved = jax.jvp(lambda x: T @ lie.exp(x), (0 * turn,), (turn,))
    direction = np.asarray(moved[1])
    built = {}
    for mode in ("implicit", "unroll"):
        build = partial(peers.theseus_graph, edges, start, weights, mode)
        told = f"GaussNewton, CholeskyDenseSolver, backward_mode={mode}"
        built[f"Theseus, {mode}"] = ("theseus-ai", told, cache(build))
    return _torch_case("Theseus, 32 poses, by the motions", built, T, direction)


def _torch_case(
    name: str,
    built: dict[str, tuple[str, str, Callable[[], tuple[peers.Answer, ...]]]],
    x: np.ndarray,
    direction: np.ndarray,
) -> Case:
    """Others beside their own answers: they minimise something else than we do."""
    library, _, first = next(iter(built.values()))
    alone = f"{name.split(',')[0]}, the answer"
    methods = [Method(alone, library, "forward", prepare=lambda: first()[0])] + [
        Method(f"{method}, gradient", library, told, prepare=lambda b=build: b()[1])
        for method, (library, told, build) in built.items()
    ]

    def judge_own(answers: list[Any]) -> Judged:
        slope = _slope(first()[0], x, _FAR * direction) / _FAR
        slope = float(np.sum(_weights(slope.shape) * slope))
        return judge(direction, slope, answers)

    return Case(
        name=name,
        data="generated",
        methods=methods,
        trials=[(x,)],
        judge=judge_own,
        repeats=25,
        reference=alone,
    )


#: The answer, and the gradient of the loss; of some methods that through all steps.
_Programs = tuple[Callable[[jax.Array], jax.Array], ...]


def _through_the_steps(method: jr.ICP) -> jr.ICP:
    """Differentiated as what records each operation does it: step by step, all kept."""
    steps = jr.RecursiveCheckpointAdjoint(checkpoints=method.max_steps)
    return dataclasses.replace(method, adjoint=steps)


def _weights(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(1).standard_normal(shape)


def _programs(
    answer: Callable[[jax.Array], jax.Array],
    shape: tuple[int, ...],
    through: Callable[[jax.Array], jax.Array] | None = None,
) -> _Programs:
    def gradient(of: Callable[[jax.Array], jax.Array]) -> Callable:
        return eqx.filter_jit(jax.grad(lambda x: jnp.sum(_weights(shape) * of(x))))

    programs = eqx.filter_jit(answer), gradient(answer)
    return programs if through is None else (*programs, gradient(through))


def _case(
    name: str,
    programs: _Programs,
    x: np.ndarray,
    direction: np.ndarray,
    slope: np.ndarray,
) -> Case:
    weights = _weights(slope.shape)
    told = {
        "jaxreg, the answer": "forward",
        "jaxreg, gradient": "jax.grad",
        "through the steps": "jax.grad, each step kept",
    }
    return Case(
        name=name,
        data="generated",
        methods=[
            Method(method, "jaxreg", how, partial(_call, program))
            for (method, how), program in zip(told.items(), programs, strict=False)
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
