"""Parts of a graph that were averaged on their own, brought into a known world."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import place_among
from jaxreg._core.quantile import nearest_rank
from jaxreg._core.typing import Scalar
from jaxreg.averaging.world.levels import Levels
from jaxreg.averaging.world.points import ControlPoints
from jaxreg.averaging.world.rigid_fit import (
    CHOICES,
    likeliest_place,
    spans,
    spans_upright,
)
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses
from jaxreg.linear.small import product


class Brought(NamedTuple):
    """Poses to start from in the world.

    Attributes:
        T_world_i: `(v, d+1, d+1)`, as they were in parts that nothing holds.
        held: `(v,)` frames of parts that poses hold, or points on no line, or two
            points and a level.
    """

    T_world_i: Float[Array, "v D D"]
    held: Bool[Array, " v"]


def brought(
    T_part_i: Float[Array, "v D D"],
    part: Int[Array, " v"],
    poses: KnownPoses,
    points: ControlPoints | None,
    levels: Levels | None,
    unit: Scalar,
) -> Brought:
    """Each part as one rigid body, where most of what is known of it is fitted.

    Args:
        T_part_i: poses in a frame of each part's own; in parts with fixed frames they
            are in the world.
        part: the lowest number of the frames of each frame's part.
        poses: priors and fixed frames.
        points: control points.
        levels: tilts.
        unit: the length that stands for a radian.
    """
    v, d = len(part), T_part_i.shape[-1] - 1
    # A pose is known by the places of its origin and of the tips of its axes.
    tips = jnp.concatenate([jnp.zeros((1, d)), unit * jnp.eye(d)])
    tips = tips.astype(T_part_i.dtype)
    owner, present = jnp.repeat(poses.frame, d + 1), jnp.repeat(poses.mask, d + 1)
    T_seen = T_part_i[poses.frame]
    arms = jax.vmap(lambda T: lie.act(T, tips))
    seen = arms(T_seen).reshape(-1, d)
    in_world = arms(poses.T_world_prior).reshape(-1, d)
    tried = product(poses.T_world_prior, lie.inverse(T_seen))
    if points is not None:
        owner = jnp.concatenate([owner, points.frame])
        present = jnp.concatenate([present, points.mask])
        seen = jnp.concatenate([seen, points.seen(T_part_i)])
        in_world = jnp.concatenate([in_world, points.in_world])
    fixed = jnp.zeros(v, bool).at[part].max(poses.fixed)
    if len(owner) == 0:
        return Brought(T_part_i, fixed[part])
    posed = jnp.zeros(v, bool).at[part[poses.frame]].max(poses.mask)
    is_point = jnp.arange(len(owner)) >= len(poses.frame) * (d + 1)

    def fitted(name: Array) -> tuple[Array, Array]:
        usable = present & (part[owner] == name)
        some = tried
        if len(tried) > CHOICES:
            some = tried[_spread(poses.mask & (part[poses.frame] == name))]
        up = None if levels is None else _up(levels, T_part_i, part, name)
        T, agrees, level = likeliest_place(seen, in_world, usable, some, up)
        agrees = (agrees & usable & is_point).astype(T.dtype)
        holds = spans(in_world, agrees)
        if levels is not None:
            holds = holds | (level & spans_upright(in_world, agrees))
        return T, posed[name] | holds

    def one(name: Array) -> tuple[Array, Array]:
        told = jnp.any(present & (part[owner] == name))
        known = told & (part[name] == name) & ~fixed[name]
        left = jnp.eye(d + 1, dtype=T_part_i.dtype), fixed[name]
        return control.cond(known, fitted, lambda _: left, name)

    T_world_part, held = jax.lax.map(one, jnp.arange(v, dtype=part.dtype))
    held = held[part]
    T = product(T_world_part[part], T_part_i)
    T = jnp.where((held & ~fixed[part])[:, None, None], T, T_part_i)
    return Brought(T, held)


def _up(
    levels: Levels, T_part_i: Float[Array, "v D D"], part: Int[Array, " v"], name: Array
) -> Float[Array, "3"]:
    """What points up in a part: the level that the middle one of all is nearest to.

    0 for a part without levels.
    """
    own = levels.mask & (part[levels.frame] == name)
    seen = levels.seen(T_part_i)
    tried = seen[_spread(own)]

    def middle(up: Array) -> Array:
        return nearest_rank(jnp.linalg.norm(seen - up, axis=-1), own, 0.5)

    nearest = tried[jnp.argmin(jax.lax.map(middle, tried))]
    return jnp.where(jnp.any(own), nearest, 0)


def _spread(own: Bool[Array, " p"]) -> Int[Array, " m"]:
    """At most so many rows as are tried, spread over those that are own."""
    count = jnp.cumsum(own)
    most = min(len(own), CHOICES)
    step = jnp.maximum(count[-1] / most, 1)
    wanted = jnp.floor(jnp.arange(most) * step).astype(count.dtype) + 1
    return jnp.minimum(place_among(count, wanted), len(own) - 1)
