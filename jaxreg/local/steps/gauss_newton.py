"""The Gauss-Newton step."""

from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_not_negative
from jaxreg._core.typing import Motion
from jaxreg.local.steps.base import AbstractStep, turn_and_shift
from jaxreg.local.steps.scaling import Scaled
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals import AbstractResidual


class GaussNewton(AbstractStep):
    """Solves the slightly damped normal equations of the residual.

    Attributes:
        damping: added to the diagonal of H, relative to its mean; keeps the step
            finite where the data leave a direction free.
    """

    damping: Array | float = traced(1e-5)

    def __check_init__(self) -> None:
        """Refuses negative damping."""
        check_not_negative(self, "damping")

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """R p + t -> exp(w) R p + t + v."""
        H, b = residual.normal_equations(match, weight)
        scaled = Scaled.of(H, b, match, weight)
        return turn_and_shift(T_target_source, scaled.solve(self.damping))
