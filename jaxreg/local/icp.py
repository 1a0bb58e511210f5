"""Iterative closest points, assembled from parts (PF paper, section 2.2).

index x residual x kernel x step: Besl and McKay 1992 is `PointToPoint` with
`L2` and `ClosedForm`; Chen and Medioni 1992 is `PointToPlane` with `GaussNewton`;
Segal et al. 2009 (GICP) is `PlaneToPlane` with `GaussNewton`; Fitzgibbon 2003 (LM-ICP)
is `PointToPoint` with `Huber` and `LevenbergMarquardt`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.status import Status
from jaxreg._core.typing import Key, Mask, Motion, Points, Scalar
from jaxreg.cloud import PointCloud, median_spacing, thin
from jaxreg.geometry import lie
from jaxreg.local.base import AbstractRegistrar, Modes, RegistrationSolution
from jaxreg.local.curvature import Curvature, is_degenerate
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.problem import Match, Problem, match
from jaxreg.local.residuals import AbstractResidual, PlaneToPlane
from jaxreg.local.score import score, score_match
from jaxreg.local.steps import (
    AbstractStep,
    GaussNewton,
    GradientDescent,
    decoupled_error,
)
from jaxreg.neighbours import AbstractIndex, BruteForce, exact_index
from jaxreg.robust import AbstractKernel, GemanMcClure


# Points of the target that tell its share on the source, to 0.02.
_SCORED_POINTS = 512


class _State(eqx.Module):
    """Of a descent: `row` and `width` belong to the last match, at `T_matched`."""

    T: Float[Array, "D D"]
    T_matched: Float[Array, "D D"]
    row: Int[Array, " n"]
    first_sq_residual: Float[Array, " n"]
    width: Float[Array, ""]
    num_steps: Int[Array, ""]
    moving: Bool[Array, ""]


class ICP(AbstractRegistrar):
    """Local registration from an initial guess (identity of centred clouds if none).

    The kernel's width follows the residuals (`AbstractKernel.width_of`), falling
    monotonically, not below `width_end` sample spacings of the target.

    Attributes:
        residual: what is made small.
        kernel: how much a residual counts.
        step: how the pose follows.
        index: class of the index of closest points; None chooses the faster exact one.
        max_steps: iterations at most.
        max_points: both clouds are thinned to about this many points.
        max_correspondence_distance: farther pairs do not count, in the unit of the
            input; infinite by default, as the kernel bounds what far pairs do.
        width_end: final kernel width in sample spacings.
        tolerance: the loop stops when a step turns by less than this many radians and
            shifts by less than this share of the target's radius, at the final width.

    Fails: TOO_FEW_POINTS, NON_FINITE, MAX_STEPS; LOW_OVERLAP where nothing agrees;
    DEGENERATE where the matched surfaces leave a direction free (it is left as in the
    guess); DIVERGED where the end fits worse than the guess, which is returned
    (the scores are those of the end).

    Gradients: with respect to both clouds at the solution, correspondences, kernel
    weights and normals held (the derivative of one step there, which is that of the
    fixed point up to the curvature of the residual). Nothing flows to `init`.
    """

    # Discs thirty times thicker than GICP's reach the solution from farther away, with
    # the same accuracy: their planes hold a sliding match less hard.
    residual: AbstractResidual = eqx.field(default_factory=lambda: PlaneToPlane(0.03))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    index: type[AbstractIndex] | None = eqx.field(default=None, static=True)
    max_steps: int = eqx.field(default=60, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    max_correspondence_distance: Array | float = traced(float("inf"))
    width_end: Array | float = traced(1.0)
    tolerance: Array | float = traced(1e-4)

    def __check_init__(self) -> None:
        """Refuses counts that leave nothing to do."""
        for name in ("max_steps", "max_points"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"ICP: {name} must be at least 1, found {getattr(self, name)}."
                )

    def in_unit(self, length: Scalar) -> "ICP":
        """With the correspondence distance in `length`s."""
        limit = jnp.asarray(self.max_correspondence_distance, length.dtype) / length
        return eqx.tree_at(lambda m: m.max_correspondence_distance, self, limit)

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Thinned to `max_points`, in spatial order, with normals."""
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
        spacing = median_spacing(target.points, target.mask)
        problem = Problem.of(source, target, self._indexed(target))
        frozen, init = lax.stop_gradient((problem, init))
        state = self._descend(frozen, init, spacing)

        found = self._within_reach(match(problem, state.T_matched, state.row))
        weight = lax.stop_gradient(self._optimiser.weights(found, state.width))
        T = self._last_step(state.T_matched, found, weight)
        worse = self._worse_than(state, frozen, lax.stop_gradient(found))
        T = jnp.where(worse, init, T)

        spacing = jnp.maximum(spacing, median_spacing(source.points, source.mask))
        there = score_match(found, spacing)
        back = self._score_of_target(source, target, lax.stop_gradient(T), spacing)
        status = jnp.where(state.moving, Status.MAX_STEPS, Status.CONVERGED)
        degenerate = is_degenerate(self.residual, found, weight)
        status = jnp.where(degenerate, Status.DEGENERATE, status)
        status = jnp.where(there.fitness > 0, status, Status.LOW_OVERLAP)
        status = jnp.where(worse, Status.DIVERGED, status)
        status = jnp.where(jnp.all(jnp.isfinite(T)), status, Status.NON_FINITE)
        curvature = Curvature.of(self.residual, found, weight)
        return RegistrationSolution(
            T_target_source=T,
            status=status.astype(jnp.int32),
            fitness=there.fitness,
            inlier_rmse=there.inlier_rmse,
            num_inliers=there.num_inliers,
            overlap=jnp.minimum(there.fitness, back),
            num_steps=state.num_steps,
            H=curvature.H,
            b=curvature.b,
            error=curvature.error,
            covariance=curvature.covariance,
            modes=Modes(T[None], jnp.ones(1, dtype), there.fitness[None]),
        )

    @property
    def _optimiser(self) -> LocalOptimiser:
        return LocalOptimiser(self.residual, self.kernel, self.step)

    def _indexed(self, cloud: PointCloud) -> AbstractIndex:
        index = self.index or exact_index(cloud.points.shape[0])
        return index.build(cloud.points, cloud.mask)

    def _within_reach(self, found: Match) -> Match:
        near = found.sq_residual <= jnp.asarray(self.max_correspondence_distance) ** 2
        return eqx.tree_at(
            lambda m: (m.mask, m.agreement),
            found,
            (found.mask & near, jnp.where(near, found.agreement, 0)),
        )

    def _descend(
        self, problem: Problem, init: Motion, spacing: Float[Array, ""]
    ) -> _State:
        """The end of the descent."""
        floor = self.width_end * spacing

        def body(state: _State) -> _State:
            found = self._within_reach(match(problem, state.T))
            width = self.kernel.width_of(found.sq_residual, found.mask)
            width = jnp.maximum(jnp.minimum(width, state.width), floor)
            T = lie.orthonormalise(self._optimiser.update(state.T, found, width))
            change = jnp.max(jnp.abs(decoupled_error(T, state.T)))
            first = state.num_steps == 0
            return _State(
                T=T,
                T_matched=state.T,
                row=found.row,
                first_sq_residual=jnp.where(
                    first, found.sq_residual, state.first_sq_residual
                ),
                width=width,
                num_steps=state.num_steps + 1,
                moving=(change > self.tolerance) | (width < 0.99 * state.width),
            )

        n = problem.source.shape[1]
        start = _State(
            T=init,
            T_matched=init,
            row=jnp.zeros(n, jnp.int32),
            first_sq_residual=jnp.zeros(n, init.dtype),
            width=jnp.asarray(jnp.inf, init.dtype),
            num_steps=jnp.zeros((), jnp.int32),
            moving=jnp.asarray(True),
        )
        return lax.while_loop(
            lambda s: s.moving & (s.num_steps < self.max_steps), body, start
        )

    def _last_step(
        self, T: Motion, found: Match, weight: Float[Array, " n"]
    ) -> Float[Array, "D D"]:
        """One step that carries the gradient: correspondences and weights held."""
        step = self.step
        # A step of gradient descent is not the solution: its derivative is not either.
        if isinstance(step, GradientDescent):
            step = cast_floats(GaussNewton(), weight.dtype)
        return step(T, found, weight, self.residual)

    def _worse_than(
        self, state: _State, problem: Problem, found: Match
    ) -> Bool[Array, ""]:
        """Whether the guess fits better than the match at the end."""
        farthest = jnp.asarray(self.max_correspondence_distance) ** 2

        def loss(sq_residual: Array) -> Array:
            sq = jnp.minimum(sq_residual, farthest)
            rho = self.kernel.rho(sq, state.width)
            return jnp.sum(jnp.where(problem.source_mask, rho, 0))

        return loss(state.first_sq_residual) < 0.999 * loss(found.sq_residual)

    def _score_of_target(
        self, source: PointCloud, target: PointCloud, T: Motion, spacing: Scalar
    ) -> Float[Array, ""]:
        """The share of the target that lies on the source."""
        # Few queries, far apart: comparing all pairs is quicker than building a tree.
        index = BruteForce.build(source.points, source.mask)
        problem = Problem.of(target, source, index)
        some = problem.every(max(target.points.shape[0] // _SCORED_POINTS, 1))
        return score(some, lie.inverse(T), spacing).fitness
