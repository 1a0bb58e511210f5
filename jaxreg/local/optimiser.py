"""One iteration of a local optimiser."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg._core.platforms import once
from jaxreg._core.typing import Motion
from jaxreg.local.steps import AbstractStep
from jaxreg.matching.problem import Match, Problem, match
from jaxreg.matching.residuals import AbstractResidual
from jaxreg.robust import AbstractKernel


class LocalOptimiser(eqx.Module):
    """The parts of one iteration: residual x kernel x step."""

    residual: AbstractResidual
    kernel: AbstractKernel
    step: AbstractStep

    def __call__(
        self, problem: Problem, T_target_source: Motion, width: Float[Array, ""]
    ) -> Motion:
        """Matches, weighs, steps."""
        found = match(problem, T_target_source)
        return self.update(T_target_source, found, width)

    def update(
        self, T_target_source: Motion, found: Match, width: Float[Array, ""]
    ) -> Motion:
        """Weighs a match and steps."""
        weight = self.weights(found, width)
        # Each row of the sums would divide anew. (True of widths that are no numbers,
        # too: what comes of them is passed on.)
        weight = once(jnp.asarray, weight, true=~(width < -jnp.inf), least=0)
        return self.step(T_target_source, found, weight, self.residual)

    def weights(self, found: Match, width: Float[Array, ""]) -> Float[Array, " n"]:
        """Kernel weights, times the agreement of normals where they are used."""
        weight = self.kernel.weight(found.sq_residual, width)
        if self.residual.uses_normals:
            return weight * found.agreement
        return weight * found.mask

    def repeat(
        self, problem: Problem, T_target_source: Motion, widths: Float[Array, " r"]
    ) -> Motion:
        """One iteration per kernel width (the PF paper's R steps)."""

        def body(T: Array, width: Array) -> tuple[Array, None]:
            return self(problem, T, width), None

        return control.scan(body, T_target_source, widths)[0]
