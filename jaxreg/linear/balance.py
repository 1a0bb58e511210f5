"""The implicit function theorem for a few unknowns.

A solver ends where pulls balance: b(x, a) = 0 at the tangent x = 0 from its answer,
with a all that they depend on. So x' = -(db/dx)^-1 (db/da) a', whatever steps led
there: neither time nor memory depend on their number.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.linear.small import least_norm_solution


# Singular values below this share of the largest, in units of rounding, are free.
_FREE = 100


class AbstractBalance(eqx.Module):
    """Pulls that vanish at an answer; its fields are what they depend on."""

    @property
    @abc.abstractmethod
    def like(self) -> Float[Array, " k"]:
        """Any array of the shape and dtype of the tangent."""

    @abc.abstractmethod
    def ready(self) -> "AbstractBalance":
        """With what it only needs once it is differentiated; asked for pulls then."""

    @abc.abstractmethod
    def pulls(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """Their sum b at a tangent from the answer."""

    @abc.abstractmethod
    def solve(self, x: Float[Array, " k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
        """The least y with db/dx y = b, `by_slopes` unless more is known of it."""


def by_slopes(
    at: AbstractBalance, x: Float[Array, " k"], b: Float[Array, " k"]
) -> Float[Array, " k"]:
    """The least y with db/dx y = b; directions that are free get nothing."""
    A = jax.jacfwd(at.pulls)(x)
    return least_norm_solution(A, b, _FREE * float(jnp.finfo(A.dtype).eps))


@eqx.filter_custom_jvp
def balanced(at: AbstractBalance) -> Float[Array, " k"]:
    """The tangent from an answer to the balance: zero, with derivatives of any order.

    Nothing is computed for these until they are asked for.
    """
    zero = jnp.zeros_like(at.like)
    # A constant has no lanes under `vmap`, but its tangent has: JAX mixes them up.
    return jnp.where(jnp.isnan(at.like), -zero, zero)


@balanced.def_jvp
def _balanced_jvp(
    primals: tuple[AbstractBalance], tangents: tuple
) -> tuple[Array, Array]:
    x = balanced(*primals)
    at, tangent = eqx.filter_jvp(lambda at: at.ready(), primals, tangents)
    along = eqx.filter_jvp(lambda at: at.pulls(x), (at,), (tangent,))[1]
    if along is None:  # nothing that is differentiated has an influence
        return x, jnp.zeros_like(x)
    return x, -at.solve(x, along)
