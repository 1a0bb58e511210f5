"""A step by any solver of optimistix."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul, traced
from jaxreg._core.checks import check_counts, check_positive
from jaxreg._core.solver import Solver
from jaxreg._core.typing import Motion
from jaxreg.linear.balance import AbstractBalance, balanced, by_slopes
from jaxreg.linear.condensed import AbstractSquares, condensed
from jaxreg.local.steps.base import (
    AbstractStep,
    tangent_slopes,
    turn_and_shift,
)
from jaxreg.local.steps.scaling import Scaled, gyration_radius
from jaxreg.matching.problem import Match, moved
from jaxreg.matching.residuals import AbstractResidual


class OptimistixStep(AbstractStep):
    """The minimum that a solver of optimistix finds, matches and weights being held.

        solver = optimistix.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
        method = jr.ICP(step=jr.OptimistixStep(solver))

    Unknowns are turns in radians and shifts in radii of gyration from the pose, which
    is the centre anew at each step: so it stays on the group, and the tolerances of the
    solver have no unit. A step that would raise the energy, or is not finite, leaves
    the pose.

    Not the default: `GaussNewton` takes one step on each match, where a solver takes
    several and needs an evaluation more to see that it is done. For 2,000 points of the
    Bunny that is 9.9 ms for 8.7, with Gauss-Newton, LM, Dogleg or BFGS, and a first
    call of 16 to 19 s for 14; matches are as many, and errors the same.

    Gradients: those of the minimum of the held energy, by the implicit function
    theorem. Where ICP is at rest they have no influence.

    Attributes:
        solver: a minimiser or least-squares solver of optimistix. Its numbers are
            traced, all else is static.
        damping: as of `GaussNewton`: the square of the unknowns counts so much beside
            an energy whose mean curvature by shifts is one.
        max_steps: evaluations at most, of which the first is that of the pose: with
            two `optimistix.GaussNewton` takes the step of `GaussNewton`.
    """

    solver: Solver = eqx.field(
        converter=partial(Solver.of, name="OptimistixStep: solver")
    )
    damping: Array | float = traced(1e-5)
    max_steps: int = eqx.field(default=256, static=True)

    def __check_init__(self) -> None:
        """Refuses no damping, without which free directions have no minimum."""
        check_positive(self, "damping")
        check_counts(self, max_steps=2)

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """R p + t -> exp(w) R p + t + v, or the pose itself."""
        energy = _Held.of(T_target_source, match, weight, residual, self.damping)
        held: Any = lax.stop_gradient(energy)
        zero = jnp.zeros_like(energy.unit)
        found = self.solver.lower(
            held.value, eqx.Partial(condensed, held), zero, self.max_steps
        )
        # Not where either is NaN.
        falls = held.value(found.x) <= held.value(zero)
        x = jnp.where(falls & jnp.all(jnp.isfinite(found.x)), found.x, 0)
        x = x + balanced(_Minimum(energy, x))
        return turn_and_shift(T_target_source, energy.unit * x)


class _Held(AbstractSquares):
    """The energy of a match by the tangent from its pose, free of units."""

    T: Motion
    match: Match
    weight: Float[Array, " n"]
    residual: AbstractResidual
    unit: Float[Array, " k"]
    scale: Float[Array, ""]
    damping: Float[Array, ""]

    @classmethod
    def of(
        cls,
        T: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
        damping: Array | float,
    ) -> "_Held":
        """With shifts counted in radii of gyration, energies in their stiffness."""
        scaled = Scaled.of(*residual.normal_equations(match, weight), match, weight)
        radius = gyration_radius(match, weight)
        radius = jnp.where(radius > 0, radius, 1)
        return cls(
            T,
            match,
            weight,
            residual,
            unit=radius * scaled.unit,
            scale=scaled.scale / radius**2,
            damping=jnp.asarray(damping, T.dtype),
        )

    def value(self, x: Float[Array, " k"]) -> Float[Array, ""]:
        """Of the moved match, and of the damping."""
        energy = self.residual.energy(self._moved(x), self.weight)
        return self.scale * energy + self.damping * jnp.sum(x * x) / 2

    def normal_equations(
        self, x: Float[Array, " k"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """Those of the moved match, which are by tangents from where it is."""
        H, b = self.residual.normal_equations(self._moved(x), self.weight)
        J = tangent_slopes(self.unit * x) * self.unit
        b = self.scale * jnp.sum(J * b[:, None], axis=0) - self.damping * x
        H = self.scale * full_matmul(J.T, full_matmul(H, J))
        return H + self.damping * jnp.eye(len(x), dtype=x.dtype), b

    def _moved(self, x: Float[Array, " k"]) -> Match:
        return moved(self.match, self.T, turn_and_shift(self.T, self.unit * x))


class _Minimum(AbstractBalance):
    """Where the solver ended; x is held."""

    energy: _Held
    x: Float[Array, " k"]

    @property
    def like(self) -> Float[Array, " k"]:
        """The tangent that was found."""
        return self.x

    def ready(self) -> "_Minimum":
        """As it is."""
        return self

    def pulls(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """Minus the slope of the energy."""
        return self.energy.normal_equations(self.x + x)[1]

    def solve(self, x: Float[Array, " k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
        """By the slopes of the pulls."""
        return by_slopes(self, x, b)
