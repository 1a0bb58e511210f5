"""From poses that may be the answer to one: refinement, evidence, status."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.adjoint import refusing
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.local import Curvature, Rest, at_rest
from jaxreg.matching import NO_EVIDENCE, Evidence, Problem
from jaxreg.particle.candidates import APART, Candidates, LogPrior
from jaxreg.particle.last_digits import LastRest, last_digits
from jaxreg.particle.modes import first_within
from jaxreg.particle.pair import ExactPair, Pair
from jaxreg.particle.refine import followed, polished, polishing, refined
from jaxreg.registrar import Modes, RegistrationSolution
from jaxreg.robust import AbstractKernel


#: Log odds of the first mode against all others together, below which it is one of
#: several: at these, with equal odds before, one answer in four would be wrong. (Judged
#: with patches in place of firmness, of 276 pairs of views of a room 106 had evidence
#: and held, 53 of them wrong; 29 stood out so, one of them wrong.)
LEAST_ODDS = 1.0
# Proposals that share less of the source are not judged.
_LEAST_SHARED = 1 / 7
# Modes of so much less evidence than the first are not worth the last steps.
_HOPELESS = 6.0
# Steps of the most accurate residual, where it is close already.
_POLISH = 8


_UNREFINED = (
    "Without refinement (refine_steps=0) the answer is a particle, which no equation "
    "holds: it has no derivative. Refine it, or register by ICP() from it."
)


def conclude(
    pair: Pair,
    candidates: Candidates,
    log_prior: LogPrior | None = None,
    *,
    kernel: AbstractKernel,
    num_modes: int,
    refine_steps: int,
    min_log_evidence: Array | float,
) -> RegistrationSolution:
    """The solution of a search.

    Args:
        pair: what was searched, with the derivatives that poses are to follow.
        candidates: what may be the answer: the poses after the first `num_modes` of
            them count where surfaces hold them and a seventh of the source is shared.
        log_prior: of a pose, added to its log evidence.
        kernel: of the refinement, likewise.
        num_modes: how many modes the solution has.
        refine_steps: steps on all points; the modes are then ordered by their
            evidence. Without, by energy: the answer is the particle of least energy.
        min_log_evidence: of less the status is LOW_OVERLAP.
    """
    refines, moving = refine_steps > 0, (pair, kernel)
    pair, kernel = lax.stop_gradient(moving)
    exact = pair.exact
    found = _judged(pair, exact, kernel, candidates, num_modes, refine_steps, log_prior)
    mass = _weights(found.log_evidence, found.sound) if refines else found.mass
    enough = found.log_evidence[0] >= min_log_evidence
    T_modes, curvatures = _accurate(pair, exact, kernel, found, enough, refines)
    if refines:
        T_modes = _followed(*moving, exact, T_modes, found.sound, enough)
    else:
        T_modes = refusing(T_modes, moving, _UNREFINED)
    evidence = found.evidence
    doubtful = ~found.holds[0] | (_log_odds(found.log_evidence) < LEAST_ODDS)
    rested = candidates.finished | refines
    status = _status(found.sound[0], enough, doubtful, pair, rested)
    best, curvature = jax.tree.map(lambda x: x[0], (evidence, curvatures))
    return RegistrationSolution(
        T_target_source=T_modes[0],
        status=status,
        fitness=best.fitness,
        inlier_rmse=best.inlier_rmse,
        num_inliers=best.num_inliers,
        overlap=best.overlap,
        log_evidence=found.log_evidence[0],
        num_steps=(candidates.num_steps + refine_steps).astype(jnp.int32),
        H=curvature.H,
        b=curvature.b,
        error=curvature.error,
        covariance=curvature.covariance,
        modes=Modes(
            T_modes,
            mass,
            evidence.fitness,
            jnp.where(found.sound, evidence.overlap, 0),
            evidence.inlier_rmse,
            found.log_evidence,
            curvatures.covariance,
        ),
        trace=candidates.trace,
    )


class _Judged(NamedTuple):
    """Poses that may be the answer, with their weights, judged; best first.

    Where surfaces hold none of them, as those of a sphere, no pose can be told from
    others: they are judged by whether the surfaces coincide.
    """

    T: Float[Array, "q D D"]
    mass: Float[Array, " q"]
    sound: Bool[Array, " q"]
    evidence: Evidence
    holds: Bool[Array, " q"]

    @property
    def log_evidence(self) -> Float[Array, " q"]:
        """Of each; `NO_EVIDENCE` of those that are no modes."""
        held = jnp.any(self.sound & self.holds)
        told = jnp.where(held, self.evidence.log_evidence, self.evidence.contact)
        return jnp.where(self.sound, told, NO_EVIDENCE)


def _judged(
    pair: Pair,
    exact: ExactPair,
    kernel: AbstractKernel,
    candidates: Candidates,
    num_modes: int,
    refine_steps: int,
    log_prior: LogPrior | None,
) -> _Judged:
    """The candidates refined, those of most evidence first; as many as modes."""
    T, mass = candidates.T, candidates.mass
    judged, spacing = pair.judged, pair.spacing
    widths = jnp.geomspace(
        2 * jnp.maximum(spacing, judged.spacing),
        0.5 * spacing,
        refine_steps,
        dtype=T.dtype,
    )
    T, sound = refined(pair.problem, kernel, T, mass > 0, widths)
    evidence = (exact if judged is pair else judged.exact).witness.of_poses(T, sound)
    if log_prior is not None:
        known = jax.vmap(log_prior)(T)
        evidence = dataclasses.replace(
            evidence,
            log_evidence=evidence.log_evidence + known,
            contact=evidence.contact + known,
        )
    holds = evidence.grip.holds
    first = jnp.arange(len(sound)) < num_modes
    sound = sound & (first | _convincing(evidence.overlap, holds))
    found = _Judged(T, mass, sound, evidence, holds)
    order = jnp.arange(num_modes)
    if refine_steps:
        order = jnp.argsort(-found.log_evidence)[:num_modes]
    found = jax.tree.map(lambda x: x[order], found)
    # Refinement may lead two of them to one pose.
    limit = jnp.asarray(APART, T.dtype)
    first = first_within(found.T, angle=limit, distance=limit)
    return found._replace(sound=found.sound & (first == jnp.arange(num_modes)))


def _accurate(
    pair: Pair,
    exact: ExactPair,
    kernel: AbstractKernel,
    found: _Judged,
    enough: Bool[Array, ""],
    refines: bool,
) -> tuple[Float[Array, "q D D"], Curvature]:
    """The poses after their last steps, and the curvatures there."""
    log_evidence, sound = found.log_evidence, found.sound
    hopeful = log_evidence > log_evidence[0] - _HOPELESS
    width, steps = 0.5 * pair.spacing, _POLISH if refines else 0
    how = exact.problem, kernel, found.T
    if not steps or pair.source.fine is None:
        return polished(*how, sound, hopeful, width, steps)
    closer = sound[0] & enough
    others = sound.at[0].set(sound[0] & ~closer)
    every = polished(*how, others, hopeful, width, steps)
    first = jax.tree.map(lambda x: x[0], every)
    last = control.cond(
        closer,
        lambda first: last_digits(pair, kernel, first[0], width),
        lambda first: first,
        first,
    )
    return jax.tree.map(lambda x, y: x.at[0].set(y), every, last)


def _followed(
    pair: Pair,
    kernel: AbstractKernel,
    exact: ExactPair,
    T: Float[Array, "q D D"],
    sound: Bool[Array, " q"],
    enough: Bool[Array, ""],
) -> Float[Array, "q D D"]:
    """The poses with the derivatives of the balance at their last steps."""
    width = 0.5 * pair.spacing
    problem = Problem.of(pair.source, pair.target, exact.target_index)
    optimiser = polishing(kernel, T.dtype)
    # The first outside of a loop: JAX drops rules of derivatives in those.
    first = at_rest(Rest(optimiser=optimiser, problem=problem, width=width, T=T[0]))[0]
    if pair.source.fine is not None:
        last = at_rest(LastRest(pair=pair, kernel=kernel, width=width, T=T[0]))[0]
        first = jnp.where(enough, last, first)
    first = jnp.where(sound[0], first, T[0])
    others = followed(optimiser, problem, width, T[1:], sound[1:])
    return jnp.concatenate([first[None], others])


def _convincing(
    overlap: Float[Array, " q"], holds: Bool[Array, " q"]
) -> Bool[Array, " q"]:
    """Which proposals count: those that are held, and by more than a patch.

    Particles descend to where clouds share much; the evidence was learned there.
    Features find small patches that fit each other as if they were the same: 9 % of
    two scans of opposite sides of the sculpture.
    """
    return holds & (overlap >= _LEAST_SHARED)


def _log_odds(log_evidence: Float[Array, " q"]) -> Scalar:
    """Of the first mode against all others together, at equal odds before.

    Others count also where they can slip: judged with patches in place of firmness, of
    12 pairs of views of a room that stood out but for such walls on walls 5 lay wrong.
    """
    others = jnp.append(log_evidence[1:], NO_EVIDENCE)
    return log_evidence[0] - jax.nn.logsumexp(others)


def _weights(
    log_evidence: Float[Array, " q"], used: Bool[Array, " q"]
) -> Float[Array, " q"]:
    """Shares of the posterior, equal before."""
    relative = jnp.exp(log_evidence - jnp.max(log_evidence))
    # A mode in use has a weight, though it may underflow.
    tiny = jnp.finfo(relative.dtype).tiny
    weight = jnp.where(used, jnp.maximum(relative, tiny), 0)
    return weight / jnp.maximum(jnp.sum(weight), tiny)


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
