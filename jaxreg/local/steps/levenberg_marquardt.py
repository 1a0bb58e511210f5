"""The Levenberg-Marquardt step."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_positive
from jaxreg._core.typing import Motion
from jaxreg.local.steps.base import AbstractStep, turn_and_shift
from jaxreg.local.steps.scaling import Scaled
from jaxreg.matching.problem import Match, moved
from jaxreg.matching.residuals import AbstractResidual


class _Trial(eqx.Module):
    damping: Float[Array, ""]
    falls: Bool[Array, ""]
    tries: Int[Array, ""]


class LevenbergMarquardt(AbstractStep):
    """A Gauss-Newton step, damped until the energy falls.

    Correspondences and weights are held. The damping starts low, so that a good step
    is that of Gauss-Newton, and is raised tenfold at each try; if no try lowers the
    energy, the pose stays. So the held energy never rises.

    ICP with this step and a robust kernel is LM-ICP (Fitzgibbon 2003), but for its
    distance transform (see `VoxelTable`).

    Gradients: those of the step with the damping that was accepted (the lowest, if
    none was): the choice of the damping is cut.

    Attributes:
        damping: of the first try, added to the diagonal of H relative to its mean.
        max_tries: energies evaluated at most.
    """

    damping: Array | float = traced(1e-5)
    max_tries: int = eqx.field(default=8, static=True)

    def __check_init__(self) -> None:
        """Refuses no damping, which cannot be raised, and no try."""
        check_positive(self, "damping")
        check_counts(self, max_tries=1)

    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """R p + t -> exp(w) R p + t + v, or the pose itself."""
        H, b = residual.normal_equations(match, weight)
        scaled = Scaled.of(H, b, match, weight)
        trial = self._search(T_target_source, match, weight, residual, scaled)
        start = jnp.asarray(self.damping, b.dtype)
        tangent = scaled.solve(jnp.where(trial.falls, trial.damping, start))
        # Zero where the pose stays, but with the derivative of the step.
        stay = jnp.where(trial.falls, 0, lax.stop_gradient(tangent))
        return turn_and_shift(T_target_source, tangent - stay)

    def _search(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
        scaled: Scaled,
    ) -> _Trial:
        held = lax.stop_gradient((T_target_source, match, weight, residual, scaled))
        T, match, weight, residual, scaled = held
        before = residual.energy(match, weight)

        def attempt(last: _Trial) -> _Trial:
            damping = 10 * last.damping
            T_new = turn_and_shift(T, scaled.solve(damping))
            after = residual.energy(moved(match, T, T_new), weight)
            return _Trial(damping, after < before, last.tries + 1)

        start = lax.stop_gradient(jnp.asarray(self.damping, before.dtype))
        return control.while_loop(
            lambda s: ~s.falls & (s.tries < self.max_tries),
            attempt,
            _Trial(start / 10, jnp.asarray(False), jnp.zeros((), jnp.int32)),
        )
