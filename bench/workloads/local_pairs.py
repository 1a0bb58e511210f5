"""Local registration of one pair, from raw points to pose."""

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

import jaxreg as jr
from bench.case import Case, Method, Options
from bench.peers.local_settings import Peer, peers
from bench.workloads.local_data import accuracy, draw, load


#: Points, and how many pairs are drawn; three calls of each.
DRAWS = {500: 20, 2_000: 12, 10_000: 6, 100_000: 3}


def cases(options: Options) -> Iterator[Case]:
    """A case per number of points."""
    shape = load(None if options.quick else options.data)
    sizes = {2_000: 6} if options.quick else DRAWS
    for num, count in sizes.items():
        pairs = [draw(shape, num, seed) for seed in range(count)]
        some: list[Peer] = [p for p in peers() if p.smallest <= num <= p.largest]
        yield Case(
            name=f"{num} points",
            data=shape.name,
            methods=[*own_methods(), pose_alone(), *(p.method for p in some)],
            trials=[(p.source, p.target, shape.extent) for p in pairs],
            judge=partial(accuracy, pairs=pairs, extent=shape.extent),
            repeats=3,
            reference="small_gicp GICP",
            x=num,
            x_label="points",
        )


def own_methods() -> list[Method]:
    """`register` from the identity, as a user calls it."""
    method = jr.ICP()
    solve = partial(_solve, method)
    return [Method("jaxreg ICP", "jaxreg", written_out(method), solve)]


def pose_alone() -> Method:
    """The same where a user's `jit` keeps the pose alone, which is all that peers tell.

    What nobody asks for is not computed: covariance, evidence, overlap.
    """
    method = jr.ICP()
    told = f"jit, of it T_target_source alone: {written_out(method)}"

    @jax.jit
    def pose(source: Any, target: Any, init: Any) -> Any:
        return jr.register(source, target, method, init).T_target_source

    solve = partial(_solve_for_pose, pose)
    return Method("jaxreg ICP, pose alone", "jaxreg", told, solve)


def _solve(method: Any, source: np.ndarray, target: np.ndarray, _: float) -> np.ndarray:
    solution = jr.register(source, target, method, np.eye(4, dtype=np.float32))
    return np.asarray(solution.T_target_source)


def _solve_for_pose(
    pose: Any, source: np.ndarray, target: np.ndarray, _: float
) -> np.ndarray:
    return np.asarray(pose(source, target, np.eye(4, dtype=np.float32)))


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
