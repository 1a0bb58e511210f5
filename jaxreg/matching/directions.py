"""Weights by which all directions of normals count alike, however many show them."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxreg.cloud import PointCloud


# Directions over which normals are balanced, and how sharply.
_DIRECTIONS, _SHARPNESS = {2: 32, 3: 128}, 16


def balanced(cloud: PointCloud) -> Float[Array, " n"]:
    """Weights of mean one over the valid points: all directions count alike."""
    d = cloud.points.shape[1]
    axes = jnp.asarray(_directions(d), cloud.points.dtype)
    cosine = jnp.matmul(cloud.normals, axes.T, precision=lax.Precision.HIGHEST)
    kernel = cosine**_SHARPNESS
    valid = cloud.mask.astype(kernel.dtype)
    num = jnp.maximum(jnp.sum(valid), 1)
    crowd = jnp.sum(valid[:, None] * kernel, axis=0) / num
    own = jnp.sum(kernel, axis=1)
    density = (kernel @ crowd) / jnp.where(own > 0, own, 1)
    # Where few points face the same way their number is chance.
    weight = jnp.where(own > 0, 1 / jnp.maximum(density, 1 / num), 0)
    weight = jnp.where(own > 0, weight, jnp.min(jnp.where(own > 0, weight, jnp.inf)))
    weight = jnp.where(jnp.isfinite(weight), weight, 1) * valid
    return weight * num / jnp.maximum(jnp.sum(weight), jnp.finfo(kernel.dtype).tiny)


def _directions(d: int) -> np.ndarray:
    """`(m, d)` axes of either sign, evenly spread."""
    m = _DIRECTIONS[d]
    step = np.arange(m) + 0.5
    if d == 2:
        return np.stack([np.cos(np.pi * step / m), np.sin(np.pi * step / m)], axis=1)
    z, turn = step / m, np.pi * (1 + 5**0.5) * step
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
