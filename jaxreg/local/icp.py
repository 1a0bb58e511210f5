"""Iterative closest points, assembled from parts (PF paper, section 2.2).

index x residual x kernel x step: Besl and McKay 1992 is `PointToPoint` with `L2` and
`ClosedForm`; Chen and Medioni 1992 is `PointToPlane` with `GaussNewton`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.status import Status
from jaxreg._core.typing import Key, Mask, Motion, Points
from jaxreg.cloud import PointCloud, median_spacing, thin
from jaxreg.geometry import lie
from jaxreg.local.base import AbstractRegistrar, Modes, RegistrationSolution
from jaxreg.local.problem import Match, Problem, match
from jaxreg.local.residuals import AbstractResidual, PointToPlane
from jaxreg.local.score import score_both_ways
from jaxreg.local.steps import AbstractStep, GaussNewton, decoupled_error
from jaxreg.neighbours import AbstractIndex, BruteForce
from jaxreg.robust import AbstractKernel, GemanMcClure


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

        return lax.scan(body, T_target_source, widths)[0]


class _State(eqx.Module):
    T: Float[Array, "D D"]
    width: Float[Array, ""]
    num_steps: Int[Array, ""]
    moving: Bool[Array, ""]


class ICP(AbstractRegistrar):
    """Local registration from an initial guess (identity of centred clouds if none).

    The kernel's width follows the residuals: three times their lower third, falling
    monotonically, not below `width_end` sample spacings of the target.

    Attributes:
        residual: what is made small.
        kernel: how much a residual counts.
        step: how the pose follows.
        index: class of the index of closest points.
        max_steps: iterations at most.
        max_points: both clouds are thinned to about this many points.
        width_end: final kernel width in sample spacings.
        tolerance: the loop stops when a step turns by less than this many radians and
            shifts by less than this share of the target's radius, at the final width.

    Fails: TOO_FEW_POINTS, NON_FINITE, MAX_STEPS; LOW_OVERLAP where nothing agrees.

    Gradients: with respect to both clouds at the solution, correspondences, kernel
    weights and normals held (the derivative of one step there, which is that of the
    fixed point up to the curvature of the residual). Nothing flows to `init`.
    """

    residual: AbstractResidual = eqx.field(default_factory=PointToPlane)
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    index: type[AbstractIndex] = eqx.field(default=BruteForce, static=True)
    max_steps: int = eqx.field(default=60, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    width_end: Array | float = traced(1.0)
    tolerance: Array | float = traced(1e-5)

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Thinned to `max_points`, with normals."""
        return thin(points, mask, self.max_points)

    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None = None,
    ) -> RegistrationSolution:
        """Descends from `init` in the prepared frames."""
        dtype = source.points.dtype
        self = cast_floats(self, dtype)
        if init is None:
            init = lie.identity(source.points.shape[1], dtype)
        spacing = lax.stop_gradient(median_spacing(target.points, target.mask))
        problem = Problem.of(
            source, target, self.index.build(target.points, target.mask)
        )
        state = self._descend(lax.stop_gradient((problem, init)), spacing)
        optimiser = LocalOptimiser(self.residual, self.kernel, self.step)
        T = self._last_step(optimiser, problem, state)
        there, back = score_both_ways(
            source,
            target,
            self.index.build(source.points, source.mask),
            problem.index,
            lax.stop_gradient(T),
            jnp.maximum(spacing, median_spacing(source.points, source.mask)),
        )
        status = jnp.where(state.moving, Status.MAX_STEPS, Status.CONVERGED)
        status = jnp.where(there.fitness > 0, status, Status.LOW_OVERLAP)
        status = jnp.where(jnp.all(jnp.isfinite(T)), status, Status.NON_FINITE)
        return RegistrationSolution(
            T_target_source=T,
            status=status.astype(jnp.int32),
            fitness=there.fitness,
            inlier_rmse=there.inlier_rmse,
            overlap=jnp.minimum(there.fitness, back.fitness),
            num_steps=state.num_steps,
            modes=Modes(T[None], jnp.ones(1, dtype), there.fitness[None]),
        )

    def _descend(
        self, start: tuple[Problem, Motion], spacing: Float[Array, ""]
    ) -> _State:
        problem, init = start
        optimiser = LocalOptimiser(self.residual, self.kernel, self.step)
        floor = self.width_end * spacing

        def body(state: _State) -> _State:
            found = match(problem, state.T)
            distance = jnp.sqrt(found.sq_residual)
            distance = jnp.where(problem.source_mask, distance, jnp.nan)
            scale = 3 * jnp.nanquantile(distance, jnp.asarray(1 / 3, distance.dtype))
            width = jnp.maximum(jnp.minimum(scale, state.width), floor)
            T = lie.orthonormalise(optimiser.update(state.T, found, width))
            change = jnp.max(jnp.abs(decoupled_error(T, state.T)))
            moving = (change > self.tolerance) | (width < 0.99 * state.width)
            return _State(T, width, state.num_steps + 1, moving)

        return lax.while_loop(
            lambda s: s.moving & (s.num_steps < self.max_steps),
            body,
            _State(
                init,
                jnp.asarray(jnp.inf, init.dtype),
                jnp.zeros((), jnp.int32),
                jnp.asarray(True),
            ),
        )

    @staticmethod
    def _last_step(optimiser: LocalOptimiser, problem: Problem, state: _State) -> Array:
        """One step that carries the gradient: correspondences and weights held."""
        found = match(problem, state.T)
        weight = lax.stop_gradient(optimiser.weights(found, state.width))
        return optimiser.step(state.T, found, weight, optimiser.residual)
