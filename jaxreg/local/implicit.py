"""Derivatives of a registered pose by the implicit function theorem.

Where a descent ends, the pulls of the matched points balance: b = 0, with weights by
the kernel. The pose is differentiated through that equation, not through the loop.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.linear.balance import AbstractBalance, balanced, by_slopes
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps import turn_and_shift
from jaxreg.matching.problem import Match, Problem, match


class AbstractRest(AbstractBalance):
    """Where a pose came to rest, and a scale if that was free; both are held."""

    T: eqx.AbstractVar[Motion]
    scale: eqx.AbstractVar[Scalar | None]

    @property
    def like(self) -> Float[Array, " k"]:
        """The tangent of the pose, and the logarithm of the scale if that is free."""
        k = 3 * (len(self.T) - 2) + (self.scale is not None)
        return jnp.broadcast_to(self.T[0, 0], k)


class Rest(AbstractRest):
    """What a descent ended with; derivatives are by the first three.

    Attributes:
        optimiser: residual, kernel and step; the last has no influence.
        problem: the pair.
        width: of the kernel.
        T: the pose.
        row: `(n,)` its matches; None: the closest points, found when they are needed.
        scale: of the source before the pose, if it is free.
        farthest: pairs farther apart do not count.
        follows: the width over that which the kernel suggests for the residuals, if it
            follows these; not above zero: it does not.
    """

    optimiser: LocalOptimiser
    problem: Problem
    width: Scalar
    T: Motion
    row: Int[Array, " n"] | None = None
    scale: Scalar | None = None
    farthest: Scalar | None = None
    follows: Scalar | None = None

    def ready(self) -> "Rest":
        """With the matches at the pose, where they are not known."""
        if self.row is not None:
            return self
        found = match(*jax.lax.stop_gradient((self.problem, self.T)))
        return dataclasses.replace(self, row=found.row)

    def pulls(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """b, and the pull on the scale if that is free."""
        found, weight = self._weighed(x)
        residual = self.optimiser.residual
        b = jnp.sum(weight[None] * residual.descents(found), axis=1)
        if self.scale is None:
            return b

        def energy(s: Array) -> Array:
            grown = dataclasses.replace(
                found, residual=found.residual - s * found.rotated
            )
            return residual.energy(grown, weight)

        zero, one = jnp.zeros_like(self.width), jnp.ones_like(self.width)
        slope = jax.jvp(energy, (zero,), (one,))[1]
        return jnp.concatenate([b, -slope[None]])

    def solve(self, x: Float[Array, " k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
        """By the slopes of the pulls."""
        return by_slopes(self, x, b)

    def _weighed(self, x: Float[Array, " k"]) -> tuple[Match, Float[Array, " n"]]:
        """The same matches at a tangent from the pose, and their weights there."""
        T, scale = _moved(self.T, self.scale, x)
        problem = self.problem if scale is None else self.problem.scaled(scale)
        found = match(problem, T, self.row, width=self.width)
        if self.farthest is not None:
            found = found.within(self.farthest)
        return found, self.optimiser.weights(found, self._width(found))

    def _width(self, found: Match) -> Scalar:
        """The width, where it follows the residuals with their derivatives."""
        if self.follows is None:
            return self.width
        # Residuals of zero have no finite slope.
        sq = jnp.where(self.follows > 0, found.sq_residual, 1)
        width = self.optimiser.kernel.width_of(sq, found.mask)
        return jnp.where(self.follows > 0, self.follows * width, self.width)


def at_rest(end: AbstractRest) -> tuple[Motion, Scalar | None]:
    """The pose and the scale, with the derivatives of those at which pulls balance."""
    T, scale = end.T, end.scale
    # A pose that is not a number pulls nothing.
    known = jnp.all(jnp.isfinite(T))
    still = jnp.where(known, T, lie.identity(len(T) - 1, T.dtype))
    x = balanced(dataclasses.replace(end, T=still))
    return _moved(T, scale, jnp.where(known, x, 0))


def _moved(
    T: Motion, scale: Scalar | None, x: Float[Array, " k"]
) -> tuple[Motion, Scalar | None]:
    """Pose and scale at a tangent."""
    if scale is None:
        return turn_and_shift(T, x), None
    return turn_and_shift(T, x[:-1]), scale * jnp.exp(x[-1])
