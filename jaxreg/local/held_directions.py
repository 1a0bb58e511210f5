"""Matrices in the directions that a Gauss-Newton matrix H holds; zero in the others."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg.linear.small import eigh


# The least answer, as a share of H, that so few points tell from none.
_LEAST_ANSWER = 0.01


def after_steps(
    A: Float[Array, "k k"], H: Float[Array, "k k"], num: int
) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    """What Gauss-Newton steps make of pulls g and of a displacement x at the start.

    Steps x <- x + H^-1 (g - A x) lead to (1 - S) x + G g. In the directions that H
    holds, with A from 0.01 to 1 times H; where A is little, few steps lead nowhere.

    Returns:
        G, which is A^-1 where A is large, and S.
    """
    white, share = _shares(A, whitening(H))
    undone = 1 - (1 - share) ** num
    gain = full_matmul(white * (undone / share)[None], white.T)
    return gain, full_matmul(full_matmul(white * undone[None], white.T), H)


def whitening(H: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """W with W^T H W = I in the directions that H holds; zero in the others."""
    diagonal = jnp.diagonal(H)
    unit = jnp.where(diagonal > 0, lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    value, vector = eigh(H * unit[:, None] * unit[None])
    held = value > len(H) * jnp.finfo(H.dtype).eps * value[-1]
    root = jnp.where(held, lax.rsqrt(jnp.where(held, value, 1)), 0)
    return unit[:, None] * vector * root[None]


def inverse_of(
    A: Float[Array, "k k"], white: Float[Array, "k k"]
) -> Float[Array, "k k"]:
    """A^-1 in the directions that H holds, given the `whitening` of H."""
    white, share = _shares(A, white)
    return full_matmul(white / share[None], white.T)


def _shares(
    A: Float[Array, "k k"], white: Float[Array, "k k"]
) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
    """Directions W with W^T H W = I in which A is diagonal, from 0.01 to 1 times H."""
    value, vector = eigh(full_matmul(white.T, full_matmul(A, white)))
    return full_matmul(white, vector), jnp.clip(value, _LEAST_ANSWER, 1)
