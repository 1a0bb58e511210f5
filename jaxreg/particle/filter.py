"""`ParticleFilter`: registration without an initial guess (the PF paper's algorithm).

    t = 0        draw from the prior, measure, weigh                 (section 4.2);
                 end here where the answer is sure                    (`draw`)
    t = 1, 2, .. resample, diffuse along the motion error (Eq. 6-8), measure,
                 weigh (Eq. 9), until the motion errors are small or t = num_times

A measurement is a few steps of a local optimiser; what it moved a particle by is the
particle's motion error, whose size and direction the next diffusion takes. The
distinct poses that are left are refined by many steps on more points and scored; beside
them, in 3D, a few that local features propose (`proposals`): where clouds share little,
wrong poses may have less energy than the right one, and the evidence decides.

Every choice is a part. The defaults are not all the paper's: many more particles are
drawn at t = 0 than are carried on; the energy is bounded and asks that normals agree,
as partial overlap needs it; the temperature of the weights is learned from the
energies; the kernel width of the optimiser falls over time. `sandhu2010` has the
paper's own.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxreg._core.arrays import traced
from jaxreg._core.checks import (
    check_counts,
    check_not_negative,
    check_pair,
    check_parts,
    check_shares,
    shown,
)
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key, Motion
from jaxreg.local import AbstractStep, GaussNewton
from jaxreg.matching import LIKELY, AbstractResidual, PointToPlane, Problem
from jaxreg.neighbours import IndexBuilder
from jaxreg.particle.candidates import Found
from jaxreg.particle.draw import SETTLE_STEPS, most_look_ups, with_settled
from jaxreg.particle.dynamics import AbstractDynamics, StochasticDynamics
from jaxreg.particle.energies import AbstractEnergy, BoundedEnergy
from jaxreg.particle.priors import AbstractPrior, GivenParticles
from jaxreg.particle.resamplers import AbstractResampler, Systematic
from jaxreg.particle.stepping import AbstractFilter, Filtering, run
from jaxreg.registrar import GivenPair
from jaxreg.robust import AbstractKernel, GemanMcClure


class ParticleFilter(AbstractFilter):
    """Global registration by a particle filter over ICP.

    Lengths are in units of the target's root mean square radius, so the unit of the
    input does not matter. One search looks up at most `num_points * most_look_ups`
    closest points, by default 7.5 million, and a tenth of that where it is sure early.

    Attributes:
        num_prior: particles drawn from the prior and measured at t = 0.
        num_particles: particles carried on from there (N).
        num_times: steps t = 1 .. num_times of the filter, at most.
        prior_steps: local steps at t = 0.
        inner_steps: local steps R of every later measurement.
        refine_steps: steps on all points that end the search; with zero the answer is
            the particle of least energy, as in the paper.
        num_points: source points that a particle is measured on.
        num_modes: distinct poses that are refined and returned.
        num_proposals: distinct poses, in 3D, that local features agree on and that are
            refined beside the modes (`jaxreg.features`). Asked for where neither `init`
            nor a prior is given and the draws were not sure; with zero never, nor
            without refinement. They count where a seventh of the source is shared and
            its surfaces hold the pose.
        num_agreeing: the draws end, and the search, as soon as so many of them have
            settled at the best pose and none elsewhere nearly as well; with zero, or an
            energy that is not bounded, all are drawn and none is settled, as in the
            paper.
        max_points: both clouds are thinned to about this many points.
        batch_size: particles in one vectorised block; small enough for a CPU's cache.
        dim: of the points that the settings are for, 2 or 3; None for both.
        prior: where the particles start; None is `GaussianPrior()` around `init` where
            that is given, else `UniformPrior()`.
        dynamics: how they move between measurements.
        resampler: how they are replaced, and when.
        energy: what they are weighed by.
        residual, kernel, step: parts of the local optimiser.
        index: what is asked for closest points: a class such as `BoxTree`, or
            `IndexOptions(VoxelTable, candidates=4)`. None: a `VoxelTable` with one
            candidate a cell.
        sample_share: effective sample size asked of the likelihoods, as a share of the
            particles (at t = 0 of those that are to be carried on, at most all).
        prior_error_share: how much of the motion error of t = 0 the dynamics see. It
            spans a descent from nowhere in particular.
        width_start, width_end: kernel width at t = 0 and at t = num_times.
        tolerance: stop when no motion error turns by more than so many radians or
            shifts by more than so many radii (the target's root mean square radius):
            then the diffusion has died.
        min_log_evidence: of less `log_evidence` than this the status is LOW_OVERLAP. At
            the default 269 of 280 right answers were believed and none of 128 wrong
            ones, but of views of walls 127 right and 6 wrong ones
            (bench/studies/evidence.md).

    Raises: ValueError while constructing, for counts that leave nothing to do; for
    points of another dimension than `dim`.

    Fails: TOO_FEW_POINTS; NON_FINITE where no energy is finite; LOW_OVERLAP where the
    evidence is below `min_log_evidence`; AMBIGUOUS where the first mode does not stand
    above all others together by log odds of 1, or where the surfaces that agree can
    slip, as those of a cylinder; without refinement MAX_STEPS where the diffusion had
    not died.

    Gradients: of the poses by every point of both clouds, by the balance of pulls at
    the last steps (implicit function theorem), in forward and reverse mode; held is
    what `ICP` holds. The last steps are few: on noisy clouds of 300 points slopes agree
    with differences of 1e-7 to 5 %, and to 1e-6 with ten times as many steps. Nothing
    else has an influence on where pulls balance; of which poses are found, of scores
    and covariances nothing is followed: stepped by hand the filter has an evidence that
    is (`iteration`, `Filtering.scan`). Poses of all statuses have finite gradients.
    Without refinement asking for them raises a TypeError.
    """

    num_prior: int = eqx.field(default=1536, static=True)
    num_particles: int = eqx.field(default=256, static=True)
    num_times: int = eqx.field(default=3, static=True)
    prior_steps: int = eqx.field(default=6, static=True)
    inner_steps: int = eqx.field(default=3, static=True)
    refine_steps: int = eqx.field(default=24, static=True)
    num_points: int = eqx.field(default=400, static=True)
    num_modes: int = eqx.field(default=16, static=True)
    num_proposals: int = eqx.field(default=4, static=True)
    num_agreeing: int = eqx.field(default=4, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    dim: int | None = eqx.field(default=None, static=True)
    prior: AbstractPrior | None = None
    dynamics: AbstractDynamics = eqx.field(default_factory=StochasticDynamics)
    resampler: AbstractResampler = eqx.field(default_factory=Systematic)
    energy: AbstractEnergy = eqx.field(default_factory=BoundedEnergy)
    residual: AbstractResidual = eqx.field(default_factory=lambda: PointToPlane(0.2))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    index: IndexBuilder | None = eqx.field(default=None, static=True)
    sample_share: Array | float = traced(0.98)
    prior_error_share: Array | float = traced(0.25)
    width_start: Array | float = traced(0.3)
    width_end: Array | float = traced(0.06)
    tolerance: Array | float = traced(1e-4)
    min_log_evidence: Array | float = traced(LIKELY)

    def __check_init__(self) -> None:
        """Refuses counts that leave nothing to do."""
        check_parts(self, dynamics=AbstractDynamics, resampler=AbstractResampler)
        check_counts(self, num_prior=1, num_times=1, prior_steps=1, inner_steps=1)
        check_counts(self, num_particles=2, num_agreeing=0)
        if self.num_particles > self.num_prior:
            raise ValueError(
                "ParticleFilter: num_particles: wanted from 2 to num_prior = "
                f"{self.num_prior}, found {self.num_particles}."
            )
        if self.dim not in (None, 2, 3):
            raise ValueError(
                f"ParticleFilter: dim: wanted None, 2 or 3, found {shown(self.dim)}."
            )
        check_shares(self, "sample_share")
        check_not_negative(self, "prior_error_share")
        if isinstance(self.prior, GivenParticles):
            self.prior.check_number(self.num_prior, "num_prior")

    @property
    def most_look_ups(self) -> int:
        """Closest points looked up for each source point where never sure."""
        drawn = self.num_prior * (self.prior_steps + 1)
        if self.settles:
            drawn = most_look_ups(self.num_prior, self.prior_steps, self.batch_size)
        return drawn + self.num_particles * self.num_times * (self.inner_steps + 1)

    @kept_program
    def iteration(
        self,
        source: object,
        target: object,
        *,
        key: Key,
        source_mask: object = None,
        target_mask: object = None,
    ) -> Filtering:
        """The filter on one pair, to be stepped by hand.

        Args:
            source: as in `register`, one pair; so are the target and the masks.
            target: likewise.
            key: draws the source points that particles are measured on.
            source_mask: likewise.
            target_mask: likewise.
        """
        pair = check_pair(source, target, source_mask, target_mask)
        return Filtering.of(self, self.problem(GivenPair(*pair), key))

    def search(self, key: Key, problem: Problem, init: Motion | None) -> Found:
        """The filter (PF paper, section 4.2)."""
        ended = run(Filtering.of(self, problem), key, init)
        state, trace = ended.state
        particles = state.particles.rows(slice(self.num_particles))
        steps = self.prior_steps + state.num_steps * self.inner_steps
        sure = jnp.asarray(False)
        if state.settled is not None:
            sure = state.num_steps == 0
            particles = with_settled(state.settled, particles, sure)
            steps = steps + SETTLE_STEPS
        return Found(particles, steps, ended.converged, sure, trace)
