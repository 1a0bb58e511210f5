"""From many measured poses to an answer: modes, refinement, evidence, status."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats
from jaxreg._core.status import Status
from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.local import Curvature, GaussNewton, LocalOptimiser
from jaxreg.matching import (
    NO_EVIDENCE,
    Evidence,
    PlaneToPlane,
    PointToPlane,
    Problem,
    match,
)
from jaxreg.particle.last_digits import last_digits
from jaxreg.particle.modes import distinct_modes, first_within
from jaxreg.particle.pair import Pair
from jaxreg.particle.state import Particles
from jaxreg.registrar import Modes, RegistrationSolution
from jaxreg.robust import AbstractKernel


#: Poses nearer than this, in radians and radii, are one mode.
APART = 0.3
#: A second mode is a rival of the first if its log evidence falls short of the first's
#: by less than this. (Poses that a symmetry makes equal differ by 0.25 at most, in 108
#: pairs of cubes, boxes, prisms and tori of 500 to 4,000 points, with noise or not.)
RIVAL_MARGIN = 0.5
# Proposals that share less of the source are not judged.
_LEAST_SHARED = 1 / 7
# Modes of so much less evidence than the first are not worth the last steps.
_HOPELESS = 6.0
# What is known beforehand may outweigh all evidence: no pose has more.
_MOST_EVIDENCE = 10.0
# Steps of the most accurate residual, where it is close already.
_POLISH = 8


Out = TypeVar("Out")


def conclude(
    pair: Pair,
    particles: Particles,
    num_steps: Int[Array, ""],
    finished: Bool[Array, ""],
    proposals: tuple[Float[Array, "r D D"], Bool[Array, " r"]] | None = None,
    log_prior: Callable[[Motion], Scalar] | None = None,
    *,
    kernel: AbstractKernel,
    num_modes: int,
    refine_steps: int,
    min_log_evidence: Array | float,
) -> RegistrationSolution:
    """The solution of a search.

    Args:
        pair: what was searched.
        particles: measured and weighted poses.
        num_steps: steps of the local optimiser that led to them.
        finished: whether they had come to rest.
        proposals: more poses to refine and judge, and which are in use; they count
            where surfaces hold them and a seventh of the source is shared.
        log_prior: of a pose, added to its log evidence.
        kernel: of the refinement.
        num_modes: distinct poses of the particles to refine and judge; of these and the
            proposals the solution has as many.
        refine_steps: steps on all points; the modes are then ordered by their
            evidence. Without, by energy: the answer is the particle of least energy.
        min_log_evidence: of less the status is LOW_OVERLAP.
    """
    dtype = particles.energy.dtype
    limit = jnp.asarray(APART, dtype)
    last = None
    if log_prior is not None:
        last = jax.vmap(log_prior)(particles.T_target_source) < -_MOST_EVIDENCE
    rows, mass = distinct_modes(particles, num_modes, last, angle=limit, distance=limit)
    spacing, exact, judged = pair.spacing, pair.exact, pair.judged
    witness = (exact if judged is pair else judged.exact).witness
    T_modes = particles.T_target_source[rows]
    if proposals is not None:
        T_more, in_use = proposals
        T_modes = jnp.concatenate([T_modes, T_more])
        mass = jnp.concatenate([mass, in_use.astype(dtype)])
    widths = jnp.geomspace(
        2 * jnp.maximum(spacing, judged.spacing),
        0.5 * spacing,
        refine_steps,
        dtype=dtype,
    )
    T_modes, sound = _refined(pair.problem, kernel, T_modes, mass > 0, widths)
    evidence = witness.of_poses(T_modes, sound)
    if log_prior is not None:
        told = evidence.log_evidence + jax.vmap(log_prior)(T_modes)
        evidence = dataclasses.replace(evidence, log_evidence=told)
    sound = sound & ((jnp.arange(len(sound)) < num_modes) | _convincing(evidence))
    by_evidence = jnp.argsort(-jnp.where(sound, evidence.log_evidence, NO_EVIDENCE))
    order = by_evidence[:num_modes] if refine_steps else jnp.arange(num_modes)
    T_modes, mass, sound, evidence = jax.tree.map(
        lambda x: x[order], (T_modes, mass, sound, evidence)
    )
    # Refinement may lead two of them to one pose.
    first = first_within(T_modes, angle=limit, distance=limit)
    sound = sound & (first == jnp.arange(num_modes))
    log_evidence = jnp.where(sound, evidence.log_evidence, NO_EVIDENCE)
    weight = _weights(log_evidence, sound)
    mass = weight if refine_steps else mass
    steps = _POLISH if refine_steps else 0
    T_modes, curvatures = _polished(
        exact.problem,
        kernel,
        T_modes,
        sound,
        log_evidence > log_evidence[0] - _HOPELESS,
        0.5 * spacing,
        steps,
    )
    best = jax.tree.map(lambda x: x[0], evidence)
    enough = log_evidence[0] >= min_log_evidence
    if steps and pair.source.fine is not None:
        first = T_modes[0], jax.tree.map(lambda x: x[0], curvatures)
        last = lax.cond(
            sound[0] & enough,
            lambda first: last_digits(pair, kernel, first[0], 0.5 * spacing),
            lambda first: first,
            first,
        )
        T_modes, curvatures = jax.tree.map(
            lambda x, y: x.at[0].set(y), (T_modes, curvatures), last
        )
    curvature = jax.tree.map(lambda x: x[0], curvatures)
    holds = evidence.grip.holds
    doubtful = ~holds[0] | _has_rival(log_evidence, holds)
    finished = finished | (refine_steps > 0)
    status = _status(sound[0], enough, doubtful, pair, finished)
    return RegistrationSolution(
        T_target_source=T_modes[0],
        status=status,
        fitness=best.fitness,
        inlier_rmse=best.inlier_rmse,
        num_inliers=best.num_inliers,
        overlap=best.overlap,
        log_evidence=log_evidence[0],
        num_steps=(num_steps + refine_steps).astype(jnp.int32),
        H=curvature.H,
        b=curvature.b,
        error=curvature.error,
        covariance=curvature.covariance,
        modes=Modes(
            T_modes,
            mass,
            evidence.fitness,
            jnp.where(sound, evidence.overlap, 0),
            evidence.inlier_rmse,
            log_evidence,
            curvatures.covariance,
        ),
    )


def _convincing(evidence: Evidence) -> Bool[Array, " q"]:
    """Which proposals count: those that are held, and by more than a patch.

    Particles descend to where clouds share much; the evidence was learned there.
    Features find small patches that fit each other as if they were the same: 9 % of
    two scans of opposite sides of the sculpture.
    """
    return evidence.grip.holds & (evidence.overlap >= _LEAST_SHARED)


def _has_rival(
    log_evidence: Float[Array, " q"], holds: Bool[Array, " q"]
) -> Bool[Array, ""]:
    """Whether another mode is about as likely as the first.

    One that can slip rivals only a first that can: walls fit on walls and slide along
    them, which is evidence of walls but not of a pose.
    """
    likely = log_evidence[1:] > log_evidence[0] - RIVAL_MARGIN
    return jnp.any(likely & (holds[1:] | ~holds[0]))


def _weights(
    log_evidence: Float[Array, " q"], used: Bool[Array, " q"]
) -> Float[Array, " q"]:
    """Shares of the posterior, equal before."""
    relative = jnp.exp(log_evidence - jnp.max(log_evidence))
    # A mode in use has a weight, though it may underflow.
    tiny = jnp.finfo(relative.dtype).tiny
    weight = jnp.where(used, jnp.maximum(relative, tiny), 0)
    return weight / jnp.maximum(jnp.sum(weight), tiny)


def _refined(
    problem: Problem,
    kernel: AbstractKernel,
    T: Float[Array, "q D D"],
    used: Bool[Array, " q"],
    widths: Float[Array, " s"],
) -> tuple[Float[Array, "q D D"], Bool[Array, " q"]]:
    """After a step of each width on all points.

    And which of the poses in use are sound; the others become the identity.
    """
    optimiser = LocalOptimiser(PointToPlane(), kernel, GaussNewton())
    optimiser = cast_floats(optimiser, T.dtype)
    if len(widths):
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
    hopeful: Bool[Array, " q"],
    width: Scalar,
    num_steps: int,
) -> tuple[Float[Array, "q D D"], Curvature]:
    """The last steps, in the metric of both surfaces, and the curvature there.

    Three times as accurate as planes of the target alone; but modes are compared
    before, as wrong ones gain more by it than right ones. What is no mode stays, and so
    do those without hope, which have a curvature only.
    """
    optimiser = LocalOptimiser(PlaneToPlane(0.01), kernel, GaussNewton())
    optimiser = cast_floats(optimiser, T.dtype)

    def polish(T: Motion) -> Motion:
        return lie.orthonormalise(
            optimiser.repeat(problem, T, jnp.full(num_steps, width))
        )

    def curvature_at(T: Motion) -> Curvature:
        return Curvature.of(optimiser, problem, T, match(problem, T), width)

    polished = _of_used(polish, T, sound & hopeful)
    T = jnp.where((sound & hopeful)[:, None, None], polished, T)
    return T, _of_used(curvature_at, T, sound)


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
    sound: Bool[Array, ""],
    enough: Bool[Array, ""],
    doubtful: Bool[Array, ""],
    pair: Pair,
    finished: Bool[Array, ""],
) -> Int[Array, ""]:
    """Of the answer, the most serious last."""
    status = jnp.where(finished, Status.CONVERGED, Status.MAX_STEPS)
    status = jnp.where(doubtful, Status.AMBIGUOUS, status)
    status = jnp.where(enough, status, Status.LOW_OVERLAP)
    status = jnp.where(sound, status, Status.NON_FINITE)
    d = pair.source.points.shape[1]
    few = jnp.minimum(jnp.sum(pair.source.mask), jnp.sum(pair.target.mask)) < d + 1
    return jnp.where(few, Status.TOO_FEW_POINTS, status).astype(jnp.int32)
