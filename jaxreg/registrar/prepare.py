"""A pair as a method's `solve` expects it: cleaned, centred and scaled, prepared."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxreg._core.arrays import on_both
from jaxreg.cloud import OTHER_UNIT, Frames, PointCloud, Side
from jaxreg.registrar.base import AbstractRegistrar


# Clouds are padded to one size where the larger is at most so many times as large.
_MAX_PADDING = 2


class PreparedPair(eqx.Module):
    """What `solve` is called with.

    Attributes:
        method: its lengths and poses in the centred frames.
        source, target: prepared clouds.
        frames: the centred ones and those of the input.
        enough: whether both clouds have at least d + 1 distinct valid points.
        unit_differs: whether one is so much larger that its unit must be another.
    """

    method: AbstractRegistrar
    source: PointCloud
    target: PointCloud
    frames: Frames
    enough: Bool[Array, ""]
    unit_differs: Bool[Array, ""]


def prepare_pair(method: AbstractRegistrar, pair: tuple[Array, ...]) -> PreparedPair:
    """Of a source, a target and their masks; traced."""
    source, target, *masks = pair
    if source.ndim != 2:
        raise ValueError(f"source: wanted shape (n, d), found {source.shape}.")
    sides = on_both(Side.of, *_levelled((source, masks[0]), (target, masks[1])))
    frames = Frames(sides[0].mean, sides[1].mean, sides[1].radius)
    method = method.in_frames(frames)
    clouds = on_both(
        lambda cloud: method.prepare(*cloud),
        *(
            ((side.points - side.mean[None]) / frames.radius, side.mask)
            for side in sides
        ),
    )
    source_cloud, target_cloud = (cloud.followed() for cloud in clouds)
    return PreparedPair(
        method,
        source_cloud.first(len(source)),
        target_cloud.first(len(target)),
        frames,
        sides[0].enough & sides[1].enough,
        jnp.abs(jnp.log(sides[0].radius / sides[1].radius)) > math.log(OTHER_UNIT),
    )


def _levelled(
    a: tuple[Array, Array], b: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Points and masks with rows added to the fewer, if they are not many.

    Clouds of one size share what is compiled for them.
    """
    num = max(len(a[1]), len(b[1]))
    if num > _MAX_PADDING * min(len(a[1]), len(b[1])):
        return a, b

    def padded(points: Array, mask: Array) -> tuple[Array, Array]:
        rows = (0, num - len(mask))
        return jnp.pad(points, (rows, (0, 0))), jnp.pad(mask, rows)

    return padded(*a), padded(*b)
