"""The gradient-descent step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion
from jaxreg.local.steps.base import AbstractStep, turn_and_shift
from jaxreg.local.steps.scaling import Scaled
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals import AbstractResidual


class GradientDescent(AbstractStep):
    """Steepest descent with the step length that minimises the quadratic model.

    The local optimiser of the PF paper's 2D experiments (section 4.1), R = 7 of which
    move a particle. Nothing is tuned: the gradient is taken with rotations counted in
    radii of gyration, so that the unit of length does not matter, and the step length
    is exact, b'b / b'Hb. It solves no system: a direction that the data leave free has
    no gradient and stays.
    """

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """R p + t -> exp(w) R p + t + v, (v, w) along b."""
        H, b = residual.normal_equations(match, weight)
        scaled = Scaled.of(H, b, match, weight)
        b = scaled.b
        curvature = jnp.sum(scaled.H * b[:, None] * b[None])
        curved = curvature > 0
        length = jnp.sum(b * b) / jnp.where(curved, curvature, 1)
        tangent = jnp.where(curved, length * scaled.unit * b, 0)
        return turn_and_shift(T_target_source, tangent)
