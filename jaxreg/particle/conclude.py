"""From many measured poses to an answer: modes, refinement, scores, polish, status."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats, on_both
from jaxreg._core.status import Status
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, levelled, median_spacing
from jaxreg.geometry import lie
from jaxreg.local import Curvature, GaussNewton, LocalOptimiser
from jaxreg.matching import (
    PlaneToPlane,
    PointToPlane,
    Problem,
    Score,
    can_slip,
    match,
    mutual_overlap,
    score_both_ways,
)
from jaxreg.neighbours import AbstractIndex
from jaxreg.particle.modes import distinct_modes, first_within
from jaxreg.particle.state import Particles
from jaxreg.registrar import Modes, RegistrationSolution
from jaxreg.robust import AbstractKernel


# Poses nearer than this, in radians and radii, are one mode.
_APART = 0.3
#: A second mode is a rival of the first if its overlap is more than this share of the
#: first's,
RIVAL_OVERLAP = 0.95
# or its weight: by chance alone, two standard errors.
_RIVAL_WEIGHT = 0.13
# Steps of the most accurate residual, where it is close already.
_POLISH = 8


Out = TypeVar("Out")


class Pair(eqx.Module):
    """Two prepared clouds with their indexes."""

    source: PointCloud
    target: PointCloud
    source_index: AbstractIndex
    target_index: AbstractIndex

    @property
    def problem(self) -> Problem:
        """The source to be registered to the target, all points."""
        return Problem.of(self.source, self.target, self.target_index)

    @property
    def spacing(self) -> Scalar:
        """Between samples of the coarser cloud."""
        return jnp.maximum(
            *on_both(
                lambda cloud: median_spacing(cloud.points, cloud.mask),
                *levelled(self.source, self.target),
            )
        )

    def scores(
        self, T: Float[Array, "q D D"], used: Bool[Array, " q"], spacing: Scalar
    ) -> tuple[Score, Float[Array, " q"]]:
        """Of the source on the target at poses in use, and the overlap."""
        clouds = self.source, self.target, self.source_index, self.target_index
        there, back = score_both_ways(*clouds, T, used, spacing)
        return there, mutual_overlap(there, back)


def conclude(
    pair: Pair,
    particles: Particles,
    num_steps: Int[Array, ""],
    finished: Bool[Array, ""],
    *,
    kernel: AbstractKernel,
    num_modes: int,
    refine_steps: int,
    min_overlap: Array | float,
) -> RegistrationSolution:
    """The solution of a search.

    Args:
        pair: what was searched.
        particles: measured and weighted poses.
        num_steps: steps of the local optimiser that led to them.
        finished: whether they had come to rest.
        kernel: of the refinement.
        num_modes: distinct poses to refine and score.
        refine_steps: steps on all points; the modes are then ordered by the overlap
            that they reach. Without, by energy: the answer is the particle of least
            energy.
        min_overlap: below this overlap the status is LOW_OVERLAP.
    """
    dtype = particles.energy.dtype
    limit = jnp.asarray(_APART, dtype)
    rows, mass = distinct_modes(particles, num_modes, angle=limit, distance=limit)
    spacing = pair.spacing
    T_modes = particles.T_target_source[rows]
    T_modes, sound = _refined(
        pair.problem, kernel, T_modes, mass > 0, spacing, refine_steps
    )
    there, overlap = pair.scores(T_modes, sound, spacing)
    overlap = jnp.where(sound, overlap, -1)
    order = jnp.argsort(-overlap) if refine_steps else jnp.arange(num_modes)
    T_modes, mass, overlap, there = jax.tree.map(
        lambda x: x[order], (T_modes, mass, overlap, there)
    )
    # Refinement may lead two of them to one pose.
    first = first_within(T_modes, angle=limit, distance=limit)
    overlap = jnp.where(first == jnp.arange(num_modes), overlap, -1)
    weight = _weights(overlap, pair)
    mass = weight if refine_steps else mass
    steps = _POLISH if refine_steps else 0
    T_modes, curvatures = _polished(
        pair.problem, kernel, T_modes, overlap >= 0, 0.5 * spacing, steps
    )
    best, curvature = jax.tree.map(lambda x: x[0], (there, curvatures))
    doubtful = can_slip(pair.problem, T_modes[0], spacing) | _has_rival(overlap, weight)
    finished = finished | (refine_steps > 0)
    status = _status(overlap[0], doubtful, pair, min_overlap, finished)
    return RegistrationSolution(
        T_target_source=T_modes[0],
        status=status,
        fitness=best.fitness,
        inlier_rmse=best.inlier_rmse,
        num_inliers=best.num_inliers,
        overlap=jnp.maximum(overlap[0], 0),
        num_steps=(num_steps + refine_steps).astype(jnp.int32),
        H=curvature.H,
        b=curvature.b,
        error=curvature.error,
        covariance=curvature.covariance,
        modes=Modes(
            T_modes,
            mass,
            there.fitness,
            jnp.maximum(overlap, 0),
            there.inlier_rmse,
            curvatures.covariance,
        ),
    )


def _has_rival(
    overlap: Float[Array, " q"], weight: Float[Array, " q"]
) -> Bool[Array, ""]:
    """Whether another mode is about as good as the first."""
    as_large = overlap[1:] > RIVAL_OVERLAP * overlap[0]
    return jnp.any(as_large | (weight[1:] > _RIVAL_WEIGHT * weight[0]))


def _weights(overlap: Float[Array, " q"], pair: Pair) -> Float[Array, " q"]:
    """Shares of the posterior, of modes with the best first.

    By how much a mode's overlap falls short of the best, in the standard error that
    the difference of two such shares has when both are the same.
    """
    best = jnp.clip(overlap[0], 0.1, 0.9)
    few = jnp.minimum(jnp.sum(pair.source.mask), jnp.sum(pair.target.mask))
    sq_error = 2 * best * (1 - best) / jnp.maximum(few, 1).astype(best.dtype)
    short = (overlap[0] - overlap) ** 2 / sq_error
    weight = jnp.where(overlap >= 0, jnp.exp(-short / 2), 0)
    # A mode in use has a weight, though it may underflow.
    weight = jnp.where(
        overlap >= 0, jnp.maximum(weight, jnp.finfo(short.dtype).tiny), 0
    )
    return weight / jnp.maximum(jnp.sum(weight), jnp.finfo(short.dtype).tiny)


def _refined(
    problem: Problem,
    kernel: AbstractKernel,
    T: Float[Array, "q D D"],
    used: Bool[Array, " q"],
    spacing: Scalar,
    num_steps: int,
) -> tuple[Float[Array, "q D D"], Bool[Array, " q"]]:
    """After many steps on all points, the width falling to the sample spacing.

    And which of the poses in use are sound; the others become the identity.
    """
    optimiser = LocalOptimiser(PointToPlane(), kernel, GaussNewton())
    optimiser = cast_floats(optimiser, T.dtype)
    if num_steps:
        widths = spacing * jnp.geomspace(2, 0.5, num_steps, dtype=T.dtype)
        T = _of_used(lambda T: optimiser.repeat(problem, T, widths), T, used)
    T = lie.orthonormalise(T)
    sound = used & jnp.all(jnp.isfinite(T), axis=(1, 2))
    eye = lie.identity(T.shape[-1] - 1, T.dtype)
    return jnp.where(sound[:, None, None], T, eye), sound


def _polished(
    problem: Problem,
    kernel: AbstractKernel,
    T: Float[Array, "q D D"],
    sound: Bool[Array, " q"],
    width: Scalar,
    num_steps: int,
) -> tuple[Float[Array, "q D D"], Curvature]:
    """The last steps, in the metric of both surfaces, and the curvature there.

    Three times as accurate as planes of the target alone; but modes are compared
    before, as wrong ones gain more by it than right ones. What is no mode stays.
    """
    optimiser = LocalOptimiser(PlaneToPlane(0.01), kernel, GaussNewton())
    optimiser = cast_floats(optimiser, T.dtype)

    def polish(T: Motion) -> tuple[Motion, Curvature]:
        T = optimiser.repeat(problem, T, jnp.full(num_steps, width))
        T = lie.orthonormalise(T)
        return T, Curvature.of(optimiser, problem, T, match(problem, T), width)

    polished, curvature = _of_used(polish, T, sound)
    return jnp.where(sound[:, None, None], polished, T), curvature


def _of_used(
    function: Callable[[Motion], Out], T: Float[Array, "q D D"], used: Bool[Array, " q"]
) -> Out:
    """Of each pose in use, one after another; zero of the others."""

    def one(mode: tuple[Motion, Bool[Array, ""]]) -> Out:
        T, used = mode
        shapes = jax.eval_shape(function, T)
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return lax.cond(used, function, lambda _: zero, T)

    return lax.map(one, (T, used))


def _status(
    overlap: Float[Array, ""],
    doubtful: Bool[Array, ""],
    pair: Pair,
    min_overlap: Array | float,
    finished: Bool[Array, ""],
) -> Int[Array, ""]:
    """Of the answer; an overlap of -1 marks one that is no mode."""
    status = jnp.where(finished, Status.CONVERGED, Status.MAX_STEPS)
    status = jnp.where(doubtful, Status.AMBIGUOUS, status)
    status = jnp.where(overlap < min_overlap, Status.LOW_OVERLAP, status)
    status = jnp.where(overlap < 0, Status.NON_FINITE, status)
    d = pair.source.points.shape[1]
    few = jnp.minimum(jnp.sum(pair.source.mask), jnp.sum(pair.target.mask)) < d + 1
    return jnp.where(few, Status.TOO_FEW_POINTS, status).astype(jnp.int32)
