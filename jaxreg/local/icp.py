"""Iterative closest points, assembled from parts (PF paper, section 2.2).

index x residual x kernel x step: Besl and McKay 1992 is `PointToPoint` with
`L2` and `ClosedForm`; Chen and Medioni 1992 is `PointToPlane` with `GaussNewton`;
Segal et al. 2009 (GICP) is `PlaneToPlane` with `GaussNewton`; Fitzgibbon 2003 (LM-ICP)
is `PointToPoint` with `Huber` and `LevenbergMarquardt`.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxreg._core.adjoint import AbstractAdjoint, ImplicitAdjoint
from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.checks import (
    as_float_array,
    check_counts,
    check_flag,
    check_not_negative,
    check_pair,
    check_parts,
    check_positive,
)
from jaxreg._core.loop import iterate
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key, Mask, Motion, Points, Scalar
from jaxreg.cloud import (
    PointCloud,
    median_spacing,
    thin,
    without_noise,
)
from jaxreg.geometry import lie
from jaxreg.local.curvature import Curvature, is_degenerate
from jaxreg.local.descent import Descending, Descent, Limits
from jaxreg.local.ended import evidence_at, fits_worse, settled, status_of
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.scale import first_guess
from jaxreg.local.steps import AbstractStep, GaussNewton
from jaxreg.matching.problem import Problem, match
from jaxreg.matching.residuals import AbstractResidual, PlaneToPlane
from jaxreg.matching.soft import SoftMatches
from jaxreg.neighbours import (
    AbstractIndex,
    IndexBuilder,
    check_index,
    index_within,
)
from jaxreg.registrar import (
    AbstractRegistrar,
    Frames,
    GivenPair,
    Modes,
    RegistrationSolution,
    prepare_pair,
)
from jaxreg.robust import AbstractKernel, GemanMcClure


class ICP(AbstractRegistrar):
    """Local registration from an initial guess (identity of centred clouds if none).

    The kernel's width follows the residuals (`AbstractKernel.width_of`), falling
    monotonically, not below `width_end` sample spacings of the target.

    Attributes:
        residual: what is made small.
        kernel: how much a residual counts.
        step: how the pose follows.
        index: class of the index of closest points, or `IndexOptions(VoxelTable,
            candidates=4)`: a class with options. None: for more than 1,500 points
            the voxel table of a `CellGrid` while steps are large, then its cells, exact
            within the sample spacing; else `BruteForce`.
        max_steps: iterations at most.
        max_points: both clouds are thinned to about this many points.
        max_correspondence_distance: farther pairs do not count, in the unit of the
            input; infinite by default, as the kernel bounds what far pairs do.
        width_end: final kernel width in sample spacings.
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many radii (the target's root mean square radius), at the
            final width.
        with_scale: whether the source may also grow or shrink: then the block of
            `T_target_source` is a rotation times that factor, without a guess it
            starts from the ratio of the clouds' radii, and H, b and the covariance
            are those of the pose at that factor.
        soft: means over the surroundings of the closest points in place of these, and
            normals and spacing that change as smoothly: for derivatives that hold for
            more than the least change. Twenty times slower; `max_points` should not be
            less than there are. None: the closest points.
        adjoint: `ImplicitAdjoint()`, or `RecursiveCheckpointAdjoint()` for few steps
            taken on purpose.

    Fails: TOO_FEW_POINTS, NON_FINITE, MAX_STEPS; LOW_OVERLAP where nothing agrees;
    DEGENERATE where the matched surfaces leave a direction free (it is left as in the
    guess); DIVERGED where the end fits worse than the guess by more than the
    standard error of their sums; then the guess is returned (the scores are those of
    the end).

    Gradients: by every point of both clouds, `width_end` and the numbers of residual
    and kernel, exact by the implicit function theorem where the loop has converged: in
    forward and reverse mode, and of second order (of many pairs through `jax.vmap`, as
    JAX drops rules of derivatives within its loops). Normals, thinned points, sample
    spacing, frames and kernel width follow the points. Held are the correspondences,
    which points are merged and which cells normals are taken from: of two clouds of 300
    points with a noise of a quarter of their spacing, differences of 1e-7 agree to
    1e-6, but those of 1e-4 and more exchange matches, and differ several times over.
    With `soft=SoftMatches()` those of 1e-3 agree within 4 % there, and within 10 % on
    scans of two lidars and an object, 4,000 points of each. A width above `width_end`
    has the slope of the residual that it was taken from: exact if the last step took
    it, but not if an earlier one did. Directions that are free do not move, and nothing
    flows to `init` but where it is returned. With `RecursiveCheckpointAdjoint()`
    through the steps, also to `init`, in reverse mode.
    """

    # Discs ten times thicker than GICP's reach the solution from farther away, with
    # the same accuracy: their planes hold a sliding match less hard.
    residual: AbstractResidual = eqx.field(default_factory=lambda: PlaneToPlane(0.01))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    index: IndexBuilder | None = eqx.field(default=None, static=True)
    max_steps: int = eqx.field(default=60, static=True)
    max_points: int = eqx.field(default=8192, static=True)
    max_correspondence_distance: Array | float = traced(float("inf"))
    width_end: Array | float = traced(1.0)
    tolerance: Array | float = traced(1e-4)
    with_scale: bool = eqx.field(default=False, static=True)
    soft: SoftMatches | None = None
    adjoint: AbstractAdjoint = ImplicitAdjoint()

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(
            self,
            residual=AbstractResidual,
            kernel=AbstractKernel,
            step=AbstractStep,
            adjoint=AbstractAdjoint,
            soft=SoftMatches | None,
        )
        check_index(self)
        check_counts(self, max_steps=1, max_points=1)
        check_positive(self, "max_correspondence_distance", "width_end")
        check_not_negative(self, "tolerance")
        check_flag(self.with_scale, "ICP: with_scale")

    def in_frames(self, frames: Frames) -> "ICP":
        """With the correspondence distance in radii."""
        radius = frames.radius
        farthest = jnp.asarray(self.max_correspondence_distance, radius.dtype)
        # The derivative of inf / radius times none is NaN.
        limited = jnp.isfinite(farthest)
        limit = jnp.where(limited, jnp.where(limited, farthest, 1) / radius, jnp.inf)
        return eqx.tree_at(lambda m: m.max_correspondence_distance, self, limit)

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Without noise that fills the box, thinned, in spatial order, with normals."""
        mask = without_noise(points, mask)
        if self.soft is None:
            return thin(points, mask, self.max_points)
        return thin(points, mask, self.max_points, self.soft.num, fading=True)

    @kept_program
    def iteration(
        self, source: object, target: object, init: object = None
    ) -> tuple[Descending, Descent]:
        """The steps on one pair, to be taken by hand, and the state before the first.

            descending, state = ICP().iteration(source, target)
            while not descending.terminate(state):
                state = descending.step(state)
            T_target_source = descending.problem.frames.leave(state.T)

        Args:
            source: `(n, d)` points.
            target: `(m, d)` points.
            init: the initial guess, by default the identity of centred clouds.
        """
        pair = GivenPair(*check_pair(source, target, None, None))
        ready = prepare_pair(self, pair)
        method = cast_floats(self.in_frames(ready.frames), pair.source.dtype)
        descending, _ = method._descending(ready.source, ready.target, ready.frames)
        T = None if init is None else ready.frames.enter(as_float_array(init, "init"))
        start = first_guess(ready.source, ready.target, T, self.with_scale)
        return descending, descending.init(start)

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
        init, start_scale = first_guess(source, target, init, self.with_scale)
        descending, spacing = self._descending(source, target)
        optimiser, problem = descending.optimiser, descending.problem
        limits = descending.limits
        descending, (init, start_scale) = self.adjoint.inputs(
            (descending, (init, start_scale))
        )
        ended = iterate(
            descending,
            descending.init((init, start_scale)),
            max_steps=self.max_steps,
            adjoint=self.adjoint,
        )
        end = ended.state
        T, scale = end.T, end.scale
        if isinstance(self.adjoint, ImplicitAdjoint):
            T, scale = settled(optimiser, problem, limits, end)

        scaled, width = problem.scaled(end.scale), end.width
        found = match(scaled, end.T_matched, end.row, width=width)
        found = found.within(limits.farthest)
        frozen, frozen_found, held = lax.stop_gradient((problem, found, end))
        weight = lax.stop_gradient(optimiser.weights(frozen_found, end.width))
        worse = fits_worse(self.kernel, held, frozen, frozen_found, limits)
        T = jnp.where(worse, init, T)
        scale = jnp.where(worse, start_scale, scale)
        evidence = evidence_at(source, target, T, scale)
        free = is_degenerate(self.residual, frozen_found, weight)
        T = lie.compose(scale * lie.rotation(T), lie.translation(T))
        status = status_of(T, ended.status, free, evidence, worse)
        curvature = Curvature.of(
            optimiser, problem.scaled(scale), end.T_matched, found, end.width
        )
        e = evidence
        told = e.fitness, e.overlap, e.inlier_rmse, e.log_evidence
        modes = Modes.alone(T, *told, curvature.covariance)
        return RegistrationSolution(
            T_target_source=T,
            status=status,
            fitness=evidence.fitness,
            inlier_rmse=evidence.inlier_rmse,
            num_inliers=evidence.num_inliers,
            overlap=evidence.overlap,
            log_evidence=evidence.log_evidence,
            num_steps=end.num_steps,
            H=curvature.H,
            b=curvature.b,
            error=curvature.error,
            covariance=curvature.covariance,
            modes=modes,
        )

    def _descending(
        self, source: PointCloud, target: PointCloud, frames: Frames | None = None
    ) -> tuple[Descending, Scalar]:
        """The steps, and the target's sample spacing."""
        spacing = median_spacing(target.points, target.mask)
        index = lax.stop_gradient(self._indexed(target, spacing))
        problem = Problem.of(source, target, index, frames)
        if self.soft is not None:
            soft = self.soft.among(*lax.stop_gradient((target.points, target.mask)))
            problem = dataclasses.replace(problem, soft=soft)
            spacing = soft.spacing(target.points, target.mask)
        optimiser = LocalOptimiser(self.residual, self.kernel, self.step)
        return Descending(optimiser, problem, self._limits(spacing)), spacing

    def _limits(self, spacing: Scalar) -> Limits:
        return Limits(
            max_steps=self.max_steps,
            with_scale=self.with_scale,
            farthest=jnp.asarray(self.max_correspondence_distance, spacing.dtype),
            floor=self.width_end * spacing,
            tolerance=jnp.asarray(self.tolerance, spacing.dtype),
        )

    def _indexed(self, cloud: PointCloud, spacing: Scalar) -> AbstractIndex:
        if self.index is None:
            return index_within(cloud.points, cloud.mask, spacing)
        return self.index.build(cloud.points, cloud.mask)
