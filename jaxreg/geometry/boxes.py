"""Axis-parallel boxes around points."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxreg._core.typing import Mask, Points


def bounding_box(points: Points, mask: Mask) -> tuple[Array, Array]:
    """Lowest and highest corner `(d,)` of the valid points; 0 and 1 without any."""
    inf = jnp.asarray(jnp.inf, points.dtype)
    low = jnp.min(jnp.where(mask[:, None], points, inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -inf), axis=0)
    filled = jnp.any(mask)
    return jnp.where(filled, low, 0), jnp.where(filled, high, 1)


def bounding_cube(points: Points, mask: Mask) -> tuple[Array, Array]:
    """Lowest corner `(d,)` and the longest side of the valid points' bounding box."""
    low, high = bounding_box(points, mask)
    side = jnp.max(high - low)
    return low, jnp.where(side > 0, side, 1)
