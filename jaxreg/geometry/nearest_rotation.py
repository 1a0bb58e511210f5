"""The rotation nearest to a matrix, with its derivative.

By one-sided Jacobi rotations M V = U S instead of LAPACK's SVD (see `linear.small`). V
and U are made right-handed by cross products, so no sign of a determinant is asked for.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg.linear.small import jacobi_rotation, num_sweeps, solve_semidefinite


@jax.custom_jvp
def nearest_rotation(M: Float[Array, "*b d d"]) -> Float[Array, "*b d d"]:
    """The rotations R that maximise trace(R^T M), nearest to M in Frobenius norm.

    The identity where M is zero, and one of several where several are as near.

    Gradients: exact wherever R is unique, i.e. unless the two smallest singular values
    (the last with the sign of det M) add to zero; there a free turn is cut.

    Reference: Kabsch 1976; Umeyama 1991 (reflections).
    """
    return _in_plane(M) if M.shape[-1] == 2 else _in_space(M)


@nearest_rotation.defjvp
def _nearest_rotation_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    (M,), (dM,) = primals, tangents
    R = nearest_rotation(M)
    R_t = jnp.swapaxes(R, -1, -2)
    # R^T M stays symmetric: dR = R W with skew W of axis w, for S = R^T M
    # (tr(S) I - S) w = axis of R^T dM - (R^T dM)^T.
    S, K = R_t @ M, R_t @ dM
    twist = K - jnp.swapaxes(K, -1, -2)
    trace = jnp.trace(S, axis1=-2, axis2=-1)
    if M.shape[-1] == 2:
        turns = jnp.abs(trace) > jnp.finfo(M.dtype).tiny
        w = jnp.where(turns, twist[..., 1, 0] / jnp.where(turns, trace, 1), 0)
        zero = jnp.zeros_like(w)
        W = jnp.stack([jnp.stack([zero, -w], -1), jnp.stack([w, zero], -1)], -2)
        return R, R @ W
    stiffness = trace[..., None, None] * jnp.eye(3, dtype=M.dtype) - S
    pull = jnp.stack([twist[..., 2, 1], twist[..., 0, 2], twist[..., 1, 0]], axis=-1)
    x, y, z = jnp.moveaxis(solve_semidefinite(stiffness, pull), -1, 0)
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    W = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return R, R @ W


def _in_plane(M: Array) -> Array:
    c, s = M[..., 0, 0] + M[..., 1, 1], M[..., 1, 0] - M[..., 0, 1]
    size = jnp.hypot(c, s)
    known = size > 0
    c = jnp.where(known, c / jnp.where(known, size, 1), 1)
    s = jnp.where(known, s / jnp.where(known, size, 1), 0)
    return jnp.stack([jnp.stack([c, -s], axis=-1), jnp.stack([s, c], axis=-1)], axis=-2)


def _in_space(M: Array) -> Array:
    largest = jnp.max(jnp.abs(M), axis=(-2, -1), keepdims=True)
    nothing = largest[..., 0, 0] == 0
    # Columns of U S, and of V, as rows.
    US = jnp.swapaxes(M / jnp.where(largest > 0, largest, 1), -1, -2)
    V = jnp.broadcast_to(jnp.eye(3, dtype=M.dtype), M.shape)
    sweeps = num_sweeps(M.dtype)
    US, V = control.fori_loop(0, sweeps, lambda _, both: _swept(*both), (US, V))
    order = jnp.argsort(-jnp.sum(US * US, axis=-1), axis=-1)[..., None]
    US, V = (jnp.take_along_axis(x, order, axis=-2) for x in (US, V))
    u = _unit(US[..., 0, :])
    rest = US[..., 1, :] - jnp.sum(u * US[..., 1, :], axis=-1, keepdims=True) * u
    eps = jnp.finfo(M.dtype).eps
    flat = jnp.sum(rest**2, axis=-1) <= eps**2 * jnp.sum(US[..., 0, :] ** 2, axis=-1)
    rest = jnp.where(flat[..., None], _across(u), rest)
    U = _right_handed(u, _unit(rest))
    V = _right_handed(V[..., 0, :], V[..., 1, :])
    R = jnp.swapaxes(U, -1, -2) @ V
    eye = jnp.broadcast_to(jnp.eye(3, dtype=M.dtype), R.shape)
    return jnp.where(nothing[..., None, None], eye, R)


def _swept(US: Array, V: Array) -> tuple[Array, Array]:
    """Each two of the three columns made orthogonal once."""
    left = [US[..., k, :] for k in range(3)]
    right = [V[..., k, :] for k in range(3)]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        p, q = left[i], left[j]
        sums = (jnp.sum(x * y, axis=-1) for x, y in ((p, p), (q, q), (p, q)))
        c, s = (x[..., None] for x in jacobi_rotation(*sums))
        left[i], left[j] = c * p - s * q, s * p + c * q
        right[i], right[j] = c * right[i] - s * right[j], s * right[i] + c * right[j]
    return jnp.stack(left, axis=-2), jnp.stack(right, axis=-2)


def _right_handed(first: Array, second: Array) -> Array:
    return jnp.stack([first, second, jnp.cross(first, second)], axis=-2)


def _across(u: Array) -> Array:
    """Some vector at a right angle: the axis that is least along u, crossed with it."""
    axis = jnp.argmin(jnp.abs(u), axis=-1)
    return jnp.cross(u, jax.nn.one_hot(axis, 3, dtype=u.dtype))


def _unit(x: Array) -> Array:
    sq = jnp.sum(x * x, axis=-1, keepdims=True)
    return jnp.where(sq > 0, x * lax.rsqrt(jnp.where(sq > 0, sq, 1)), 0)
