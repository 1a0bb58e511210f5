"""Robust kernels: how much a residual counts.

Each kernel is a function rho of the squared residual norm r^2 with a width in the unit
of the residual, used through its half-quadratic weight w(r) = rho'(r) / r, so that
iteratively reweighted least squares minimises the sum of rho (Black and Rangarajan
1996). rho(r) -> r^2 / 2 as r -> 0, except L1, where it is about |r|.

A kernel is redescending if its weights fall faster than 1 / r, so that distant
residuals lose their pull: right for outliers and partial overlap near the solution,
wrong far from it. Which to take:

    no outliers                              L2
    far from the solution                    L1, Huber
    near it, clutter or partial overlap      GemanMcClure, Cauchy, Welsch, Tukey
    the share of the overlap is known        Trimmed

    >>> from jaxreg import robust
    >>> robust.Huber().weight(jnp.array([0.25, 16.0]), jnp.array(1.0)).tolist()
    [1.0, 0.25]

Widths of zero and residuals of zero are safe: weights are finite, nothing is NaN.
"""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.arrays import traced
from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import check_shares
from jaxreg._core.quantile import masked_quantile


Values = Float[Array, "*n"]
Width = Float[Array, ""]


class AbstractKernel(BriefModule):
    """A robust loss of a residual norm, given squared."""

    described: ClassVar[str] = "a kernel such as Huber()"

    @abc.abstractmethod
    def rho(self, sq_residual: Values, width: Width) -> Values:
        """The loss."""

    @abc.abstractmethod
    def weight(self, sq_residual: Values, width: Width) -> Values:
        """rho'(r) / r: the weight of the residual in a least-squares step."""

    @abc.abstractmethod
    def width_of(
        self, sq_residual: Float[Array, " n"], mask: Bool[Array, " n"]
    ) -> Width:
        """The width that the data suggest, in the unit of the residual.

        Most kernels take `by_lower_third`.

        Args:
            sq_residual: `(n,)` squared residual norms.
            mask: `(n,)` which of them are valid.

        Returns:
            The width; zero where nothing is valid.

        Gradients: by the residual that it is taken from.
        """


def by_lower_third(
    self: AbstractKernel, sq_residual: Float[Array, " n"], mask: Bool[Array, " n"]
) -> Width:
    """Half more than the lower third of the norms: a `width_of` for most kernels.

    It follows the residuals of the points that fit, as long as a third of the points
    do. (Of 93 pairs of lidar, RGB-D and objects and guesses up to 45 degrees off ICP
    finds 204, 208, 203 and 198 of 372 with 1, 1.5, 2 and 3 of it.)
    """
    return 1.5 * jnp.sqrt(masked_quantile(sq_residual, mask, 1 / 3))


def _square(width: Width) -> Width:
    """The width squared, but large enough that its square in turn is not zero.

    Then quotients by it, and their derivatives, are not NaN (3e-10 in float32).
    """
    return jnp.maximum(width * width, jnp.finfo(width.dtype).tiny ** 0.49)


class L2(AbstractKernel):
    """rho = r^2 / 2: every residual counts alike. Ignores the width.

    Not redescending. The fastest and most accurate without outliers, ruined by one.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """r^2 / 2."""
        return sq_residual / 2

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """One."""
        return jnp.ones_like(sq_residual)


class L1(AbstractKernel):
    """rho = sqrt(r^2 + width^2) - width: the PF paper's own suggestion (section 6).

    The width only smooths the corner at zero. Not redescending, so it may be used far
    from the solution.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """sqrt(r^2 + width^2) - width, written so that it does not cancel near zero."""
        scale = jnp.sqrt(_square(width))
        return sq_residual / (jnp.sqrt(sq_residual + _square(width)) + scale)

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """1 / sqrt(r^2 + width^2)."""
        return 1 / jnp.sqrt(sq_residual + _square(width))


class Huber(AbstractKernel):
    """rho = r^2 / 2 up to the width, width (r - width / 2) beyond (Huber 1964).

    Convex and not redescending: least squares for the points that fit, and a bounded,
    but not vanishing, pull of the others. A safe choice far from the solution.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """r^2 / 2, or width (r - width / 2) where r > width."""
        sq_width = _square(width)
        # Clipped below at the width: the root of zero has no finite slope.
        norm = jnp.sqrt(jnp.maximum(sq_residual, sq_width))
        far = jnp.sqrt(sq_width) * norm - sq_width / 2
        return jnp.where(sq_residual <= sq_width, sq_residual / 2, far)

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """One, or width / r where r > width."""
        sq_width = _square(width)
        return jnp.sqrt(sq_width / jnp.maximum(sq_residual, sq_width))


class Cauchy(AbstractKernel):
    """rho = width^2 / 2 log(1 + r^2 / width^2): the likelihood of a Cauchy residual.

    Redescending, but gently: rho is not bounded, and distant residuals keep a little
    pull. Between Huber and GemanMcClure when the start is neither near nor far.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """width^2 / 2 log(1 + r^2 / width^2)."""
        sq_width = _square(width)
        return sq_width / 2 * jnp.log1p(sq_residual / sq_width)

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """1 / (1 + r^2 / width^2)."""
        return 1 / (1 + sq_residual / _square(width))


class GemanMcClure(AbstractKernel):
    """rho = r^2 / 2 / (1 + r^2 / width^2): bounded by width^2 / 2.

    Geman and McClure 1985. Redescending: residuals far beyond the width stop counting,
    right for partial overlap, but only near the solution, or with a width that starts
    large.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """r^2 / 2 / (1 + r^2 / width^2)."""
        sq_width = _square(width)
        return sq_width / 2 * (sq_residual / (sq_residual + sq_width))

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """1 / (1 + r^2 / width^2)^2."""
        return 1 / (1 + sq_residual / _square(width)) ** 2


class Tukey(AbstractKernel):
    """rho = width^2 / 6 (1 - (1 - r^2 / width^2)^3) up to the width, constant beyond.

    The biweight of Beaton and Tukey 1974. Redescending, and residuals beyond the width
    do not count at all: for the last steps, when outliers are well apart from the rest.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """width^2 / 6 (1 - (1 - u)^3) with u = r^2 / width^2 clipped at one."""
        sq_width = _square(width)
        u = jnp.minimum(sq_residual / sq_width, 1)
        # 1 - (1 - u)^3 expanded: no cancellation near zero.
        return sq_width / 6 * u * (3 - u * (3 - u))

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """(1 - u)^2 with u = r^2 / width^2 clipped at one."""
        return (1 - jnp.minimum(sq_residual / _square(width), 1)) ** 2


class Welsch(AbstractKernel):
    """rho = width^2 (1 - exp(-r^2 / (2 width^2))): correntropy; MCC paper, Eq. 3, 4.

    Redescending and bounded by width^2. Its weights are Gaussian in the residual: the
    choice where the noise of the good residuals is Gaussian of that width.
    """

    width_of = by_lower_third

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """width^2 (1 - exp(-r^2 / (2 width^2)))."""
        sq_width = _square(width)
        return -sq_width * jnp.expm1(-sq_residual / (2 * sq_width))

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """exp(-r^2 / (2 width^2))."""
        return jnp.exp(-sq_residual / (2 * _square(width)))


class Trimmed(AbstractKernel):
    """rho = min(r^2, width^2) / 2: a fixed share of the residuals counts, fully.

    Trimmed ICP (Chetverikov, Stepanov, Krsek 2005) with the least squares of the
    closest points. Redescending, and hard: the choice where the share of the overlap
    is known. The width is the distance that `share` of the residuals do not exceed.

    Attributes:
        share: the part of the residuals that counts, in (0, 1].
    """

    share: Array | float = traced(0.7)

    def __check_init__(self) -> None:
        """Refuses what is no share."""
        check_shares(self, "share")

    def rho(self, sq_residual: Values, width: Width) -> Values:
        """min(r^2, width^2) / 2."""
        return jnp.minimum(sq_residual, width * width) / 2

    def weight(self, sq_residual: Values, width: Width) -> Values:
        """One up to the width, zero beyond."""
        # A hair of tolerance: the root of the quantile, squared, may round down.
        reach = width * width * (1 + 4 * jnp.finfo(width.dtype).eps)
        return (sq_residual <= reach).astype(sq_residual.dtype)

    def width_of(
        self, sq_residual: Float[Array, " n"], mask: Bool[Array, " n"]
    ) -> Width:
        """The `share` quantile of the residual norms; zero where nothing is valid."""
        return jnp.sqrt(masked_quantile(sq_residual, mask, self.share))
