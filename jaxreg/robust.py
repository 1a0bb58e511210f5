"""Robust kernels: how much a residual counts.

Each kernel is a function rho of the squared residual norm with a width in the unit of
the residual, used through its half-quadratic weight w(r) = rho'(r) / r, so that
iteratively reweighted least squares minimises the sum of rho. rho is scaled such that
rho(r) -> r^2 / 2 as r -> 0, except L1, where it is |r|.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractKernel(eqx.Module):
    """A robust loss of a residual norm, given squared."""

    @abc.abstractmethod
    def rho(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """The loss."""

    @abc.abstractmethod
    def weight(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """rho'(r) / r: the weight of the residual in a least-squares step."""


class L2(AbstractKernel):
    """rho = r^2 / 2: every residual counts alike. Ignores the width."""

    def rho(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """r^2 / 2."""
        return sq_residual / 2

    def weight(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """One."""
        return jnp.ones_like(sq_residual)


class L1(AbstractKernel):
    """rho = sqrt(r^2 + width^2) - width: the PF paper's own suggestion (section 6).

    The width only smooths the corner at zero. Not redescending, so it may be used far
    from the solution.
    """

    def rho(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """sqrt(r^2 + width^2) - width."""
        return jnp.sqrt(sq_residual + width**2) - width

    def weight(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """1 / sqrt(r^2 + width^2)."""
        return 1 / jnp.sqrt(sq_residual + width**2)


class GemanMcClure(AbstractKernel):
    """rho = r^2 / 2 / (1 + r^2 / width^2): redescending and bounded by width^2 / 2.

    Residuals far beyond the width stop counting: right for partial overlap, but only
    near the solution.
    """

    def rho(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """r^2 / 2 / (1 + r^2 / width^2)."""
        return sq_residual / 2 / (1 + sq_residual / width**2)

    def weight(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """1 / (1 + r^2 / width^2)^2."""
        return 1 / (1 + sq_residual / width**2) ** 2


class Correntropy(AbstractKernel):
    """rho = width^2 (1 - exp(-r^2 / (2 width^2))): Welsch; MCC paper, Eq. 3, 4."""

    def rho(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """width^2 (1 - exp(-r^2 / (2 width^2)))."""
        return -(width**2) * jnp.expm1(-sq_residual / (2 * width**2))

    def weight(
        self, sq_residual: Float[Array, "*n"], width: Float[Array, ""]
    ) -> Float[Array, "*n"]:
        """exp(-r^2 / (2 width^2))."""
        return jnp.exp(-sq_residual / (2 * width**2))
