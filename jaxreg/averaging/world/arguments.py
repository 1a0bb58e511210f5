"""What is known of the world, as arrays; a wrong row is refused by its name."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxreg._core.checks import (
    as_host_numbers,
    check_rigid,
    is_concrete,
    shown,
)
from jaxreg.averaging.world.known import Known
from jaxreg.averaging.world.levels import Levels
from jaxreg.averaging.world.points import ControlPoints
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses
from jaxreg.graph.pose_graph import PoseGraph


def check_known(
    priors: object,
    fixed: object,
    control: object,
    levels: object,
    graph: PoseGraph,
    *,
    padded: bool = False,
) -> Known | None:
    """What `average` is told; None if that is nothing.

    Args:
        priors: as there.
        fixed: as there.
        control: as there.
        levels: as there.
        graph: as there.
        padded: whether rows are added, for programs of few numbers of them.
    """
    d = graph.dim
    D, k = d + 1, lie.tangent_dim(d)
    pose_rows = _rows(priors, "priors", graph, [(D, D), (k, k)])
    fixed_rows = _rows(fixed, "fixed", graph, [(D, D)])
    point_rows = _rows(control, "control", graph, [(d,), (d,), (d, d)])
    level_rows = _level_rows(levels, graph)
    if not (pose_rows or fixed_rows or point_rows or level_rows):
        return None
    for name, rows in (("priors", pose_rows), ("fixed", fixed_rows)):
        for n, row in enumerate(rows):
            check_rigid(row[1], f"{name}[{n}]")
    _check_twice(fixed_rows)
    if not (pose_rows or fixed_rows):
        _check_holds(len(point_rows), len(level_rows), d)
    places = [T[:-1, -1] for _, T, *_ in fixed_rows + pose_rows]
    places += [row[2] for row in point_rows]
    origin = None
    if all(isinstance(x, np.ndarray) and np.isfinite(x).all() for x in places):
        origin = np.array(places[0], np.float64)
    shift = np.zeros(d) if origin is None else origin
    counts = len(pose_rows), len(point_rows), len(level_rows)
    num_fixed = len(fixed_rows)
    if padded:
        num_fixed = _rounded(num_fixed)
        pose_rows, point_rows, level_rows = (
            rows + rows[:1] * (_rounded(len(rows)) - len(rows))
            for rows in (pose_rows, point_rows, level_rows)
        )
    poses = _known_poses(pose_rows, fixed_rows, shift, graph, counts[0])
    points = _control_points(point_rows, shift, graph, counts[1])
    tilts = _levels(level_rows, graph, counts[2])
    return Known(poses, points, tilts, origin, num_fixed, counts)


def _rounded(num: int) -> int:
    """None, 4, 6, 8, 12, 16, ..."""
    return rounded_up(num, 4, an_octave=2) if num else 0


def _mask(num_rows: int, count: int) -> Bool[Array, " n"]:
    """Which rows are no padding."""
    return jnp.asarray(np.arange(num_rows) < count)


def _check_holds(num_points: int, num_levels: int, d: int) -> None:
    """Points that hold a frame without known poses."""
    least = 2 if num_levels else d
    if num_points < least:
        beside = " beside levels" if num_levels else ""
        raise ValueError(
            f"control: wanted at least {least} points{beside}, or a prior or a fixed "
            f"frame, found {num_points}."
        )


def _rows(
    given: object, name: str, graph: PoseGraph, shapes: list[tuple[int, ...]]
) -> list[tuple[Any, ...]]:
    """Frame, arrays, and None for an information that is left out."""
    if given is None:
        return []
    if not isinstance(given, Sequence) or isinstance(given, str | bytes):
        raise TypeError(f"{name}: wanted a list of tuples, found {shown(given)}.")
    may_lack = name in ("priors", "control")
    least = len(shapes) - may_lack
    out = []
    for n, row in enumerate(given):
        at = f"{name}[{n}]"
        if not isinstance(row, list | tuple) or not (
            least < len(row) <= len(shapes) + 1
        ):
            raise TypeError(f"{at}: wanted {_WANTED[name]}, found {shown(row)}.")
        frame = row[0]
        if isinstance(frame, bool) or not isinstance(frame, int | np.integer):
            raise TypeError(f"{at}: wanted a frame's number, found {shown(frame)}.")
        if not 0 <= frame < graph.num_poses:
            raise ValueError(
                f"{at}: wanted a frame below {graph.num_poses}, found {frame}."
            )
        arrays = [
            None if x is None else _array(x, at, shape)
            for x, shape in zip(row[1:], shapes, strict=False)
        ]
        if any(x is None for x in arrays[:least]):
            raise TypeError(f"{at}: wanted {_WANTED[name]}, found None in it.")
        arrays += [None] * (len(shapes) - len(arrays))
        if may_lack:
            eps = float(jnp.finfo(graph.T_i_j.dtype).eps)
            _check_definite(arrays[-1], at, eps)
        out.append((int(frame), *arrays))
    return out


_WANTED = {
    "priors": "(frame, T_world_i) or (frame, T_world_i, information)",
    "fixed": "(frame, T_world_i)",
    "control": "(frame, point in it, point in the world), and an information if known",
    "levels": "(frame, what points up in it, deviation)",
}


def _level_rows(given: object, graph: PoseGraph) -> list[tuple[Any, ...]]:
    """Frame, direction of length 1, and deviation."""
    if given and graph.dim != 3:
        raise ValueError("levels: wanted a graph in 3D; in 2D nothing can tilt.")
    rows = _rows(given, "levels", graph, [(graph.dim,), ()])
    out = []
    for n, (frame, up, deviation) in enumerate(rows):
        xp = np if isinstance(up, np.ndarray) else jnp
        length = xp.sqrt(xp.sum(up**2))
        if xp is np and not length > 0:
            raise ValueError(f"levels[{n}]: wanted a direction, found zeros.")
        if isinstance(deviation, np.ndarray) and not deviation > 0:
            raise ValueError(
                f"levels[{n}]: wanted a deviation above zero, in radians, found "
                f"{deviation:.3g}."
            )
        out.append((frame, up / length, deviation))
    return out


def _array(x: object, at: str, shape: tuple[int, ...]) -> Any:
    """Of concrete numbers float64 on the host: map coordinates are long."""
    if isinstance(x, jax.Array) and not is_concrete(x):
        found = x
    else:
        found = as_host_numbers(x, at)
        if not np.isfinite(found).all():
            raise ValueError(f"{at}: wanted finite numbers.")
    if found.shape != shape:
        raise ValueError(f"{at}: wanted shape {shape}, found {found.shape}.")
    return found


def _check_definite(information: Any, at: str, eps: float) -> None:
    if not isinstance(information, np.ndarray):
        return
    if not np.allclose(information, information.T, rtol=1e-4):
        raise ValueError(f"{at}: information: wanted a symmetric matrix.")
    least, *_, most = np.linalg.eigvalsh(information)
    if not least > eps * most:
        raise ValueError(
            f"{at}: information: wanted a positive definite matrix, found eigenvalues "
            f"from {least:.3g} to {most:.3g}. Of a position alone `control` is told, "
            "of a tilt alone `levels`."
        )


def _check_twice(rows: list[tuple[Any, ...]]) -> None:
    seen: dict[int, int] = {}
    for n, (frame, *_) in enumerate(rows):
        if frame in seen:
            raise ValueError(
                f"fixed[{n}]: frame {frame} is fixed by fixed[{seen[frame]}] already."
            )
        seen[frame] = n


def _known_poses(
    priors: list[tuple[Any, ...]],
    fixed: list[tuple[Any, ...]],
    origin: np.ndarray,
    graph: PoseGraph,
    count: int,
) -> KnownPoses:
    dtype, D = graph.T_i_j.dtype, graph.dim + 1
    shift = np.zeros((D, D))
    shift[:-1, -1] = origin
    v = graph.num_poses
    rows = np.array([frame for frame, _ in fixed], np.int32)
    is_fixed = np.zeros(v, bool)
    is_fixed[rows] = True
    T_fixed = jnp.broadcast_to(jnp.eye(D, dtype=dtype), (v, D, D))
    if fixed:
        own = jnp.stack([jnp.asarray(T - shift, dtype) for _, T in fixed])
        T_fixed = T_fixed.at[rows].set(own)
    T_prior = jnp.zeros((0, D, D), dtype)
    if priors:
        T_prior = jnp.stack([jnp.asarray(T - shift, dtype) for _, T, _ in priors])
    frame = np.array([frame for frame, *_ in priors], np.int32)
    given = [info for *_, info in priors]
    information = _information(given, graph)
    return KnownPoses(
        frame=jnp.asarray(frame),
        mask=_mask(len(frame), count),
        T_world_prior=T_prior,
        information=information,
        fixed=jnp.asarray(is_fixed),
        T_world_fixed=T_fixed,
    )


def _information(given: list[Any], graph: PoseGraph) -> Any:
    """Of priors; those that tell none are as good as the middle edge."""
    info, k = graph.information, lie.tangent_dim(graph.dim)
    if info is None:
        _check_all_or_none(given, "priors")
        if not given or given[0] is None:
            return None
        return jnp.stack([jnp.asarray(x, graph.T_i_j.dtype) for x in given])
    each = jnp.where(graph.mask[:, None], jnp.diagonal(info, axis1=1, axis2=2), jnp.nan)
    middle = jnp.diag(jnp.nanmedian(each, axis=0))
    rows = [middle if x is None else jnp.asarray(x, info.dtype) for x in given]
    return jnp.stack(rows) if rows else jnp.zeros((0, k, k), info.dtype)


def _check_all_or_none(given: list[Any], name: str) -> None:
    told = [n for n, x in enumerate(given) if x is not None]
    if told and len(told) < len(given):
        missing = next(n for n, x in enumerate(given) if x is None)
        raise ValueError(
            f"{name}[{missing}]: wanted an information, as {name}[{told[0]}] has one."
        )


def _control_points(
    rows: list[tuple[Any, ...]], origin: np.ndarray, graph: PoseGraph, count: int
) -> ControlPoints | None:
    if not rows:
        return None
    dtype = graph.T_i_j.dtype
    given = [info for *_, info in rows]
    _check_all_or_none(given, "control")
    told = given[0] is not None
    return ControlPoints(
        frame=jnp.asarray(np.array([row[0] for row in rows], np.int32)),
        mask=_mask(len(rows), count),
        in_frame=jnp.stack([jnp.asarray(row[1], dtype) for row in rows]),
        in_world=jnp.stack([jnp.asarray(row[2] - origin, dtype) for row in rows]),
        information=jnp.stack([jnp.asarray(x, dtype) for x in given]) if told else None,
    )


def _levels(rows: list[tuple[Any, ...]], graph: PoseGraph, count: int) -> Levels | None:
    if not rows:
        return None
    dtype = graph.T_i_j.dtype
    return Levels(
        frame=jnp.asarray(np.array([row[0] for row in rows], np.int32)),
        mask=_mask(len(rows), count),
        up=jnp.stack([jnp.asarray(up, dtype) for _, up, _ in rows]),
        deviation=jnp.stack([jnp.asarray(x, dtype) for *_, x in rows]),
    )
