"""SE(2) and SE(3) as homogeneous matrices.

Tangent vectors are translation first, then rotation (k = 3 in 2D, 6 in 3D). The
dimension is read from the shape, the dtype is that of the input.

Most programs take exponentials and logarithms at many places, so these are written out
here: those of jaxlie 1.5 take two to three times as many operations, lose half of the
digits of motions at small angles, give float64 for float32 where both are in use, and
fail under strict promotion. The tests compare with it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.typing import Key, Motions
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.linear.small import cross, entries, of_one_rank, product


# Below this angle series are exact to float64, and quotients are not.
_SMALL = 0.03


def tangent_dim(d: int) -> int:
    """k, the number of degrees of freedom of SE(d)."""
    return 3 if d == 2 else 6


def exp(tangent: Float[Array, "*b k"]) -> Motions:
    """The motion of a tangent vector (translation first)."""
    d = 2 if tangent.shape[-1] == 3 else 3
    v, w = tangent[..., :d], tangent[..., d:]
    _, a, b = _series(w)
    turned = _cross(w, v)
    shift = v + a[..., None] * turned + b[..., None] * _cross(w, turned)
    return compose(rotation_exp(w), shift)


def _series(
    w: Float[Array, "*b r"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """Sin x / x, (1 - cos x) / x^2 and (1 - sin x / x) / x^2 of the angle x = |w|."""
    sq = _squared(w)
    wide = sq > _SMALL**2
    safe = jnp.where(wide, sq, 1)
    half = jnp.sqrt(safe) / 2
    s, c = jnp.sin(half), jnp.cos(half)
    sinc = s * c / half
    return (
        jnp.where(wide, sinc, 1 - sq / 6 + sq**2 / 120),
        jnp.where(wide, 2 * s**2 / safe, 1 / 2 - sq / 24 + sq**2 / 720),
        jnp.where(wide, (1 - sinc) / safe, 1 / 6 - sq / 120 + sq**2 / 5040),
    )


def _squared(w: Float[Array, "*b r"]) -> Float[Array, "*b"]:
    """The squared length; as terms, which compile into what uses it."""
    return sum((w[..., k] ** 2 for k in range(1, w.shape[-1])), w[..., 0] ** 2)


def log(T: Motions) -> Float[Array, "*b k"]:
    """The tangent vector of a motion (translation first); differentiable at identity.

    Rotations are read through a unit quaternion, so small departures from
    orthonormality are forgiven. At a rotation of pi one of the two logarithms is
    returned.
    """
    w, t = rotation_log(rotation(T)), translation(T)
    sq = jnp.sum(w * w, axis=-1)[..., None]
    wide = sq > _SMALL**2
    safe = jnp.where(wide, sq, 1)
    half = jnp.sqrt(safe) / 2
    c = (1 - half / jnp.tan(half)) / safe
    c = jnp.where(wide, c, 1 / 12 + sq / 720 + sq**2 / 30240)
    turned = _cross(w, t)
    return jnp.concatenate([t - turned / 2 + c * _cross(w, turned), w], axis=-1)


def log_jacobian(tangent: Float[Array, "*b k"]) -> Float[Array, "*b k k"]:
    """The derivative of `log(T exp(x))` at x = 0, from `tangent = log(T)`.

    ad / (1 - exp(-ad)) with ad the adjoint of the tangent: an even polynomial of degree
    4 beside ad / 2, as the eigenvalues of ad are 0 and, twice, i times the angle. Its
    powers are multiplied out by hand: products of matrices take five times as long.
    """
    d = 2 if tangent.shape[-1] == 3 else 3
    v, w = tangent[..., :d], tangent[..., d:]
    sq = jnp.sum(w**2, axis=-1)[..., None, None]
    wide = sq > _SMALL**2
    safe = jnp.where(wide, sq, 1)
    half = jnp.sqrt(safe) / 2
    h = half / jnp.tan(half)
    slope = h / 2 - (half / jnp.sin(half)) ** 2 / 2
    # ad / 2 + a ad^2 + b ad^4, and ad^4 = -sq ad^2 but for the corner of the velocity.
    a = jnp.where(wide, (slope - 2 * (h - 1)) / safe, 1 / 12 - sq**2 / 30240)
    b = jnp.where(wide, (slope - h + 1) / safe**2, -1 / 720 - sq / 15120)
    a, turn = a - b * sq, hat(w)
    eye = jnp.broadcast_to(jnp.eye(d, dtype=tangent.dtype), turn.shape)
    if d == 2:
        shift = jnp.stack([v[..., 1], -v[..., 0]], axis=-1)[..., None]
        corner = shift / 2 + a * product(turn, shift)
        first, last = (1 - a * sq) * eye + turn / 2, jnp.ones_like(sq)
    else:
        along = jnp.sum(v * w, axis=-1)[..., None, None]
        twice = _outer(w, w) - sq * eye
        both = _outer(v, w) + _outer(w, v) - 2 * along * eye
        corner = hat(v) / 2 + a * both - 2 * b * along * twice
        first = last = eye + turn / 2 + a * twice
    low = jnp.zeros_like(jnp.swapaxes(corner, -1, -2))
    top = jnp.concatenate([first, corner], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([low, last], axis=-1)], axis=-2)


def _outer(x: Float[Array, "*b d"], y: Float[Array, "*b d"]) -> Float[Array, "*b d d"]:
    return x[..., :, None] * y[..., None, :]


# How a rotation vector makes the matrix of its cross product.
_HAT = {
    1: np.array([[[0.0], [-1.0]], [[1.0], [0.0]]]),
    3: np.cross(np.eye(3)[None], np.eye(3)[:, None]),
}


def hat(w: Float[Array, "*b r"]) -> Float[Array, "*b d d"]:
    """The matrix of the cross product with a rotation vector."""
    parts = jnp.asarray(_HAT[w.shape[-1]], w.dtype)
    parts = jnp.expand_dims(parts, tuple(range(w.ndim - 1)))
    terms = [parts[..., k] * w[..., None, None, k] for k in range(w.shape[-1])]
    return sum(terms[1:], terms[0])


def _cross(w: Float[Array, "*b r"], v: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    """The velocity of a point at v that turns with w."""
    if v.shape[-1] == 3:
        return cross(w, v)
    return w * jnp.stack([-v[..., 1], v[..., 0]], axis=-1)


def rotation_exp(w: Float[Array, "*b r"]) -> Float[Array, "*b d d"]:
    """The rotation of a rotation vector, `(..., 1)` in 2D or `(..., 3)` in 3D.

    By the formula of Rodrigues: jaxlie's way over quaternions compiles for twice as
    long, and steps of every kind compile it.
    """
    sinc, a, _ = (x[..., None, None] for x in _series(w))
    turn, sq = hat(w), _squared(w)[..., None, None]
    eye = jnp.eye(turn.shape[-1], dtype=w.dtype)
    eye = jnp.broadcast_to(eye, turn.shape)
    if w.shape[-1] == 1:
        return (1 - a * sq) * eye + sinc * turn
    return (1 - a * sq) * eye + sinc * turn + a * w[..., :, None] * w[..., None, :]


def rotation_log(R: Float[Array, "*b d d"]) -> Float[Array, "*b r"]:
    """The rotation vector of a rotation, `(..., 1)` in 2D or `(..., 3)` in 3D.

    In 3D through a multiple of its quaternion q: of the four rows of 4 q q^T, which are
    sums of entries, one whose diagonal is large, so that no digit is lost (Shepperd
    1978).
    """
    if R.shape[-1] == 2:
        return jnp.arctan2(R[..., 1:, 0], R[..., :1, 0])
    (a, ab, ac), (ba, b, bc), (ca, cb, c) = entries(R)
    x, y, z, xy, xz, yz = cb - bc, ac - ca, ba - ab, ab + ba, ac + ca, bc + cb
    rows = (
        (1 + (a + b + c), x, y, z),
        (x, 1 + (a - b - c), xy, xz),
        (y, xy, 1 + (b - a - c), yz),
        (z, xz, yz, 1 + (c - a - b)),
    )
    low, first, last = c < 0, a > b, a < -b
    cosine, *sine = (
        jnp.where(low, jnp.where(first, of_x, of_y), jnp.where(last, of_z, of_1))
        for of_1, of_x, of_y, of_z in zip(*rows, strict=True)
    )
    sq = sum((part * part for part in sine[1:]), sine[0] * sine[0])
    wide = sq > jnp.finfo(R.dtype).eps ** 0.5 * cosine * cosine
    size, safe = jnp.sqrt(jnp.where(wide, sq, 1)), jnp.where(wide, 1, cosine)
    angle = jnp.arctan2(jnp.where(cosine < 0, -size, size), jnp.abs(cosine))
    ratio = jnp.where(wide, 2 * angle / size, (2 - 2 / 3 * sq / safe**2) / safe)
    return jnp.stack([ratio * part for part in sine], axis=-1)


def adjoint(T: Motions) -> Float[Array, "*b k k"]:
    """Ad(T): `T exp(v) inv(T) = exp(Ad(T) v)`."""
    R, t = rotation(T), translation(T)
    if T.shape[-1] == 3:
        shift = jnp.stack([t[..., 1], -t[..., 0]], axis=-1)[..., None]
        turn = jnp.ones_like(shift[..., :1, :])
    else:
        # A product of matrices may be run in reduced precision on accelerators.
        shift = product(hat(t), R)
        turn = R
    low = jnp.zeros((*turn.shape[:-1], R.shape[-1]), T.dtype)
    top = jnp.concatenate([R, shift], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([low, turn], axis=-1)], axis=-2)


def compose(
    rotation: Float[Array, "*b d d"], translation: Float[Array, "*b d"]
) -> Motions:
    """The homogeneous matrix of a rotation and a translation."""
    d = rotation.shape[-1]
    batch = jnp.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    rotation = jnp.broadcast_to(rotation, (*batch, d, d))
    translation = jnp.broadcast_to(translation, (*batch, d))
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    return _with_last_row(top)


def _with_last_row(top: Float[Array, "*b d D"]) -> Motions:
    *batch, d, _ = top.shape
    last = jnp.asarray([[0.0] * d + [1.0]], top.dtype)
    return jnp.concatenate([top, jnp.broadcast_to(last, (*batch, 1, d + 1))], axis=-2)


def rotation(T: Motions) -> Float[Array, "*b d d"]:
    """The rotation block."""
    return T[..., :-1, :-1]


def translation(T: Motions) -> Float[Array, "*b d"]:
    """The translation column."""
    return T[..., :-1, -1]


def inverse(T: Motions) -> Motions:
    """The inverse motion, by transposition."""
    R_inv = jnp.swapaxes(rotation(T), -1, -2)
    return compose(R_inv, -product(R_inv, translation(T)[..., None])[..., 0])


def between(
    T_a_b: Float[Array, "*#b D D"], T_a_c: Float[Array, "*#b D D"]
) -> Float[Array, "*b D D"]:
    """`T_b_c`, the inverse of the one times the other."""
    T_a_b, T_a_c = of_one_rank(T_a_b, T_a_c)
    shift = translation(T_a_c) - translation(T_a_b)
    moved = jnp.concatenate([rotation(T_a_c), shift[..., None]], axis=-1)
    return _with_last_row(product(jnp.swapaxes(rotation(T_a_b), -1, -2), moved))


def act(T: Float[Array, "D D"], points: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """Applies one motion to points.

    Written as a broadcast multiply and sum: a matrix product may be run in reduced
    precision on accelerators.
    """
    batch = tuple(range(points.ndim - 1))
    R, t = (jnp.expand_dims(x, batch) for x in (rotation(T), translation(T)))
    return jnp.sum(points[..., None, :] * R, axis=-1) + t


def identity(d: int, dtype: jnp.dtype | type, batch: tuple[int, ...] = ()) -> Motions:
    """Identity motions with leading batch axes."""
    return jnp.broadcast_to(jnp.eye(d + 1, dtype=dtype), (*batch, d + 1, d + 1))


def orthonormalise(T: Motions) -> Motions:
    """The motion whose rotation is nearest in Frobenius norm."""
    return compose(nearest_rotation(rotation(T)), translation(T))


def straightened(T: Motions) -> Motions:
    """A product of many motions, which has drifted off the group by rounding, on it.

    One step of Newton's iteration to the polar factor: exact to second order in the
    departure, and a tenth of what `orthonormalise` takes to compile.
    """
    R = rotation(T)
    gram = product(jnp.swapaxes(R, -1, -2), R)
    eye = jnp.broadcast_to(jnp.eye(R.shape[-1], dtype=R.dtype), R.shape)
    return compose(product(R, 1.5 * eye - 0.5 * gram), translation(T))


def random_rotations(
    key: Key, num: int, d: int, dtype: jnp.dtype | type
) -> Float[Array, "p d d"]:
    """Rotations drawn uniformly from SO(d)."""
    if d == 2:
        angle = jax.random.uniform(key, (num,), dtype, -jnp.pi, jnp.pi)
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([jnp.stack([c, -s], -1), jnp.stack([s, c], -1)], -2)
    q = jax.random.normal(key, (num, 4), dtype)
    q = q / jnp.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = q[:, 0], q[:, 1], q[:, 2], q[:, 3]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_angle(R: Float[Array, "*b d d"]) -> Float[Array, "*b"]:
    """The angle of rotation in [0, pi], accurate also near 0 and pi (no arccos)."""
    if R.shape[-1] == 2:
        return jnp.abs(
            jnp.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])
        )
    vee = jnp.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        axis=-1,
    )
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    sq = jnp.sum(vee * vee, axis=-1)
    sine = jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)
    return jnp.arctan2(sine, trace - 1)
