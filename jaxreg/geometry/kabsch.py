"""The weighted rigid fit of corresponding points in closed form.

Reference: Kabsch 1976; Umeyama 1991 (reflections).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Points
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation


def kabsch(
    source: Points, target: Points, weight: Float[Array, " n"] | None = None
) -> Motion:
    """The motion that minimises sum_i w_i |T source_i - target_i|^2 (PF paper, Eq. 3).

    Args:
        source: `(n, d)` points.
        target: `(n, d)` points that correspond to `source` row by row.
        weight: `(n,)` weights of at least 0, or None for all one. Their scale does not
            matter. If they are all zero, the identity is returned.

    Returns:
        `T_target_source`, `(d+1, d+1)`. If the points leave a rotation free (all on a
        line, or one point), one of the minimisers.

    Gradients: with respect to points and weights by the rule of `nearest_rotation`.
    """
    if weight is None:
        weight = jnp.ones(source.shape[:1], dtype=source.dtype)
    total = jnp.sum(weight)
    w = weight / jnp.where(total > 0, total, 1)
    source_mean = jnp.sum(w[:, None] * source, axis=0)
    target_mean = jnp.sum(w[:, None] * target, axis=0)
    p, q = source - source_mean, target - target_mean
    R = nearest_rotation(jnp.einsum("n,ni,nj->ij", w, q, p))
    T = lie.compose(R, target_mean - R @ source_mean)
    return jnp.where(total > 0, T, jnp.eye(T.shape[-1], dtype=T.dtype))
