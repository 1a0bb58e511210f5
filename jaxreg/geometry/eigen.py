"""The least eigenvector of symmetric 2 x 2 and 3 x 3 matrices, many at once.

In closed form over arrays of entries, which XLA vectorises; a batched `eigh` calls
LAPACK matrix by matrix and takes a hundred times longer.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def least_eigenvectors(
    entries: Float[Array, "d d n"],
) -> tuple[Float[Array, "d n"], Float[Array, " n"], Float[Array, " n"]]:
    """Unit eigenvectors of the least eigenvalue, of arbitrary sign.

    Args:
        entries: entry (i, j) of n symmetric positive semidefinite matrices at [i, j].

    Returns:
        Eigenvectors (any unit vector or zero where the least eigenvalue is not
        simple), the second least and the largest eigenvalues (equal in 2D).
    """
    return _in_plane(entries) if entries.shape[0] == 2 else _in_space(entries)


def _in_plane(a: Array) -> tuple[Array, Array, Array]:
    half = (a[0, 0] - a[1, 1]) / 2
    largest = (a[0, 0] + a[1, 1]) / 2 + jnp.hypot(half, a[0, 1])
    angle = jnp.arctan2(a[0, 1], half) / 2  # of the largest eigenvector
    return jnp.stack([-jnp.sin(angle), jnp.cos(angle)]), largest, largest


def _in_space(a: Array) -> tuple[Array, Array, Array]:
    """Smith 1961, Eigenvalues of a symmetric 3 x 3 matrix."""
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3
    scale = jnp.maximum(mean, jnp.finfo(a.dtype).tiny ** 0.25)
    a, mean = a / scale, mean / scale
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
        vector = jnp.where(sq_other > sq_length, other, vector)
        sq_length = jnp.maximum(sq_length, sq_other)
    length = jnp.sqrt(sq_length)
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
