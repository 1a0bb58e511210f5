"""The least eigenvector of symmetric 2 x 2 and 3 x 3 matrices, many at once.

In closed form over arrays of entries, which XLA vectorises; a batched `eigh` calls
LAPACK matrix by matrix and takes a hundred times longer.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Eigenvalues that differ by less, in units of rounding and of the largest, coincide.
_APART = 100


@jax.custom_jvp
def least_eigenvectors(
    entries: Float[Array, "d d n"],
) -> tuple[Float[Array, "d n"], Float[Array, " n"], Float[Array, " n"]]:
    """Unit eigenvectors of the least eigenvalue, of arbitrary sign.

    Args:
        entries: entry (i, j) of n symmetric positive semidefinite matrices at [i, j].

    Returns:
        Eigenvectors (any unit vector or zero where the least eigenvalue is not
        simple), the second least and the largest eigenvalues (equal in 2D).

    Gradients: of the eigenvectors exact, zero where the least eigenvalue is not simple;
    the eigenvalues are there to be compared, theirs are cut.
    """
    return _in_plane(entries) if entries.shape[0] == 2 else _in_space(entries)


@least_eigenvectors.defjvp
def _least_eigenvectors_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple:
    """By n' = -B^+ A' n with B = A - n n^T A n, whose inverse the plane across n has.

    There B has the trace s and the determinant p of A's other eigenvalues less the
    least, so B^-1 = (s - B) / p (Cayley and Hamilton).
    """
    (a,), (da,) = primals, tangents
    n, second, largest = least_eigenvectors(a)
    least = _dot(n, _times(a, n))
    eye = jnp.eye(len(n), dtype=a.dtype)[:, :, None]
    b = a - least[None, None] * eye
    pull = _times(da, n)
    pull = pull - n * _dot(n, pull)[None]
    total = jnp.trace(b)
    if len(n) == 2:
        turn, determinant = pull, total
    else:
        turn = total[None] * pull - _times(b, pull)
        minors = [b[i, i] * b[j, j] - b[i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
        determinant = minors[0] + minors[1] + minors[2]
    unit = jnp.maximum(largest, 0) ** (len(n) - 1)
    apart = determinant > _APART * jnp.finfo(a.dtype).eps * unit
    apart, determinant = apart[None], determinant[None]
    turn = jnp.where(apart, -turn / jnp.where(apart, determinant, 1), 0)
    zero = jnp.zeros_like(second)
    return (n, second, largest), (turn, zero, zero)


def _times(a: Float[Array, "d d n"], x: Float[Array, "d n"]) -> Float[Array, "d n"]:
    return jnp.stack([_dot(row, x) for row in a])


def _dot(x: Float[Array, "d n"], y: Float[Array, "d n"]) -> Float[Array, " n"]:
    return sum((x[i] * y[i] for i in range(1, len(x))), x[0] * y[0])


def _in_plane(a: Array) -> tuple[Array, Array, Array]:
    half = (a[0, 0] - a[1, 1]) / 2
    largest = (a[0, 0] + a[1, 1]) / 2 + jnp.hypot(half, a[0, 1])
    angle = jnp.arctan2(a[0, 1], half) / 2  # of the largest eigenvector
    return jnp.stack([-jnp.sin(angle), jnp.cos(angle)]), largest, largest


def _in_space(a: Array) -> tuple[Array, Array, Array]:
    """Smith 1961, Eigenvalues of a symmetric 3 x 3 matrix."""
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3
    scale = jnp.maximum(mean, jnp.finfo(a.dtype).tiny ** 0.25)
    a, mean = a / scale[None, None], mean / scale
    xx, yy, zz = a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean
    xy, xz, yz = a[0, 1], a[0, 2], a[1, 2]
    size = jnp.sqrt((xx**2 + yy**2 + zz**2 + 2 * (xy**2 + xz**2 + yz**2)) / 6)
    size = jnp.maximum(size, jnp.finfo(a.dtype).eps)
    determinant = (
        xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    )
    angle = jnp.arccos(jnp.clip(determinant / (2 * size**3), -1, 1)) / 3
    largest = mean + 2 * size * jnp.cos(angle)
    least = mean + 2 * size * jnp.cos(angle + 2 * jnp.pi / 3)
    middle = 3 * mean - largest - least
    # Rows of A - least I are orthogonal to the eigenvector: their largest product.
    x, y, z = a[0, 0] - least, a[1, 1] - least, a[2, 2] - least
    rows = [(x, xy, xz), (xy, y, yz), (xz, yz, z)]
    vector, sq_length = _cross(rows[0], rows[1])
    for i, j in ((0, 2), (1, 2)):
        other, sq_other = _cross(rows[i], rows[j])
        vector = jnp.where((sq_other > sq_length)[None], other, vector)
        sq_length = jnp.maximum(sq_length, sq_other)
    length = jnp.sqrt(sq_length)[None]
    vector = jnp.where(length > 0, vector / jnp.where(length > 0, length, 1), 0)
    return vector, middle * scale, largest * scale


def _cross(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, Array]:
    out = jnp.stack(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )
    return out, out[0] ** 2 + out[1] ** 2 + out[2] ** 2
