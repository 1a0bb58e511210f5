"""Sums of many squares as few rows, for solvers that ask for a vector of residuals.

Of a sum of squares of thousands of residuals r with Jacobian J, a least-squares solver
uses |r|^2, J^T r and J^T J. A vector of k + 1 rows has all three in common with r:
R^T R = J^T J is the square root of the normal equations, and the last row, which has no
slope, makes up for the value. So a step costs one pass over the residuals, and no
factors of a matrix as tall as they are many.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.linear.small import root_semidefinite


class AbstractSquares(eqx.Module):
    """Half a sum of squares that depends on a few unknowns."""

    @abc.abstractmethod
    def value(self, x: Float[Array, " k"]) -> Float[Array, ""]:
        """The energy."""

    @abc.abstractmethod
    def normal_equations(
        self, x: Float[Array, " k"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """H, positive semidefinite, and b, minus the gradient of the energy."""


@eqx.filter_custom_jvp
def condensed(squares: AbstractSquares, x: Float[Array, " k"]) -> Float[Array, " rows"]:
    """Rows with half that sum of squares; only x has derivatives."""
    return _rows(squares, x)[0]


@condensed.def_jvp
def _condensed_jvp(
    primals: tuple[AbstractSquares, Array], tangents: tuple
) -> tuple[Array, Array]:
    rows, slopes = _rows(*primals)
    along = jnp.sum(slopes * tangents[1][None], axis=1)
    return rows, jnp.append(along, jnp.zeros_like(along[0]))


def _rows(squares: AbstractSquares, x: Array) -> tuple[Array, Array]:
    slopes, rows = root_semidefinite(*squares.normal_equations(x))
    left = 2 * squares.value(x) - jnp.sum(rows * rows)
    return jnp.append(-rows, jnp.sqrt(jnp.maximum(left, 0))), slopes
