"""The weighted rigid fit of corresponding points in closed form, with its derivative.

Reference: Kabsch 1976; Umeyama 1991 (reflections); the derivative is that of the
orthogonal Procrustes problem. Plain differentiation through the SVD gives NaN as soon
as two singular values coincide, although the rotation itself is smooth there.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Points
from jaxreg.geometry import lie


@jax.custom_jvp
def nearest_rotation(M: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The rotation R that maximises trace(R^T M).

    Gradients: exact wherever R is unique, i.e. unless the two smallest singular values
    (the last with the sign of det M) add to zero; there the free direction is cut.
    """
    return _signed_svd(M)[0]


def _signed_svd(M: Array) -> tuple[Array, Array, Array, Array]:
    U, s, Vt = jnp.linalg.svd(M, full_matrices=False)
    sign = jnp.where(jnp.linalg.det(U) * jnp.linalg.det(Vt) < 0, -1, 1).astype(M.dtype)
    U, s = U.at[:, -1].multiply(sign), s.at[-1].multiply(sign)
    return U @ Vt, U, s, Vt


@nearest_rotation.defjvp
def _nearest_rotation_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    (M,), (dM,) = primals, tangents
    R, U, s, Vt = _signed_svd(M)
    # dR = U W Vt with skew W solving W_ij (s_i + s_j) = (K - K^T)_ij, K = U^T dM V.
    K = U.T @ dM @ Vt.T
    total = s[:, None] + s[None, :]
    tiny = jnp.finfo(M.dtype).eps * (jnp.abs(s[0]) + jnp.finfo(M.dtype).tiny)
    fixed = jnp.abs(total) > tiny
    W = jnp.where(fixed, (K - K.T) / jnp.where(fixed, total, 1), 0)
    return R, U @ W @ Vt


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
