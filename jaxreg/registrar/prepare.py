"""A pair as a method's `solve` expects it: cleaned, centred and scaled, prepared."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxreg._core.arrays import on_both
from jaxreg.cloud import OTHER_UNIT, Frames, PointCloud, Side
from jaxreg.registrar.base import AbstractRegistrar


# Clouds are padded to one size where the larger is at most so many times as large.
_MAX_PADDING = 2


class GivenPair(NamedTuple):
    """A pair as `register` has checked it.

    Attributes:
        source, target: `(n, d)` and `(m, d)` points.
        source_mask, target_mask: which of them are valid.
        viewpoints: `(2, d)` where their scanners stood, NaN where that is not known;
            None if it is of neither.
    """

    source: Array
    target: Array
    source_mask: Array
    target_mask: Array
    viewpoints: Array | None = None


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


def prepare_pair(method: AbstractRegistrar, pair: GivenPair) -> PreparedPair:
    """Of a source, a target, their masks and perhaps their viewpoints; traced."""
    num, other = len(pair.source), len(pair.target)
    if pair.source.ndim != 2:
        raise ValueError(f"source: wanted shape (n, d), found {pair.source.shape}.")
    given = (pair.source, pair.source_mask), (pair.target, pair.target_mask)
    sides = on_both(Side.of, *_levelled(*given))
    frames = Frames(sides[0].mean, sides[1].mean, sides[1].radius)
    method = method.in_frames(frames)
    clouds = on_both(
        lambda cloud: method.prepare(*cloud),
        *(
            ((side.points - side.mean[None]) / frames.radius, side.mask)
            for side in sides
        ),
    )
    clouds = tuple(cloud.followed() for cloud in clouds)
    if pair.viewpoints is not None:
        means = jnp.stack([side.mean for side in sides])
        eyes = (pair.viewpoints - means) / frames.radius
        seen = zip(clouds, eyes, strict=True)
        clouds = on_both(lambda x: x[0].seen_from(x[1]), *seen)
    return PreparedPair(
        method,
        clouds[0].first(num),
        clouds[1].first(other),
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
