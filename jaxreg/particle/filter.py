"""`ParticleFilter`: registration without an initial guess (the PF paper's algorithm).

    t = 0        draw from the prior, measure, weigh                 (section 4.2);
                 end here where the answer is sure                    (`draw`)
    t = 1, 2, .. resample, diffuse along the motion error (Eq. 6-8), measure,
                 weigh (Eq. 9), until the motion errors are small or t = num_times

A measurement is a few steps of a local optimiser; what it moved a particle by is the
particle's motion error, whose size and direction the next diffusion takes. The
distinct poses that are left are refined by many steps on more points and scored.

Every choice is a part. The defaults are not all the paper's: many more particles are
drawn at t = 0 than are carried on; the energy is bounded and asks that normals agree,
as partial overlap needs it; the temperature of the weights is learned from the
energies; the kernel width of the optimiser falls over time. `sandhu2010` has the
paper's own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.checks import (
    check_counts,
    check_not_negative,
    check_parts,
    check_shares,
)
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.local import AbstractStep, GaussNewton, LocalOptimiser
from jaxreg.matching import AbstractResidual, PointToPlane, Problem
from jaxreg.particle.base import AbstractSearch, Found
from jaxreg.particle.draw import (
    SETTLE_STEPS,
    Drawn,
    draw_until_sure,
    most_look_ups,
)
from jaxreg.particle.dynamics import AbstractDynamics, StochasticDynamics
from jaxreg.particle.energies import AbstractEnergy, BoundedEnergy
from jaxreg.particle.measure import measure
from jaxreg.particle.priors import AbstractPrior, GivenParticles
from jaxreg.particle.resamplers import AbstractResampler, Systematic
from jaxreg.particle.state import Particles
from jaxreg.particle.trace import no_rows, with_row
from jaxreg.particle.weights import log_likelihood, normalised
from jaxreg.registrar import SearchTrace
from jaxreg.robust import AbstractKernel, GemanMcClure


class _Carry(eqx.Module):
    particles: Particles
    time: Int[Array, ""]
    moving: Bool[Array, ""]
    trace: SearchTrace


class ParticleFilter(AbstractSearch):
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
        num_agreeing: the draws end, and the search, as soon as so many of them have
            settled at the best pose and none elsewhere nearly as well; with zero, or an
            energy that is not bounded, all are drawn and none is settled, as in the
            paper.
        max_points: both clouds are thinned to about this many points.
        batch_size: particles in one vectorised block; small enough for a CPU's cache.
        prior: where the particles start; None is `GaussianPrior()` around `init` where
            that is given, else `UniformPrior()`.
        dynamics: how they move between measurements.
        resampler: how they are replaced, and when.
        energy: what they are weighed by.
        residual, kernel, step: parts of the local optimiser.
        sample_share: effective sample size asked of the likelihoods, as a share of the
            particles (at t = 0 of those that are to be carried on, at most all).
        prior_error_share: how much of the motion error of t = 0 the dynamics see. It
            spans a descent from nowhere in particular.
        width_start, width_end: kernel width at t = 0 and at t = num_times.
        tolerance: the filter stops when no particle's motion error exceeds this many
            radians and radii: then the diffusion has died.
        min_overlap: least overlap of a pose that is believed.

    Raises: ValueError while constructing, for counts that leave nothing to do.

    Fails: TOO_FEW_POINTS; NON_FINITE where no energy is finite; LOW_OVERLAP where the
    overlap is below `min_overlap`; AMBIGUOUS where a second mode is nearly as good,
    or where the surfaces that agree can slip, as those of a cylinder; without
    refinement MAX_STEPS where the diffusion had not died.

    Gradients: none; refine with `ICP` from the answer to differentiate it.
    """

    num_prior: int = eqx.field(default=1536, static=True)
    num_particles: int = eqx.field(default=256, static=True)
    num_times: int = eqx.field(default=3, static=True)
    prior_steps: int = eqx.field(default=6, static=True)
    inner_steps: int = eqx.field(default=3, static=True)
    refine_steps: int = eqx.field(default=24, static=True)
    num_points: int = eqx.field(default=400, static=True)
    num_modes: int = eqx.field(default=16, static=True)
    num_agreeing: int = eqx.field(default=4, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    prior: AbstractPrior | None = None
    dynamics: AbstractDynamics = eqx.field(default_factory=StochasticDynamics)
    resampler: AbstractResampler = eqx.field(default_factory=Systematic)
    energy: AbstractEnergy = eqx.field(default_factory=BoundedEnergy)
    residual: AbstractResidual = eqx.field(default_factory=lambda: PointToPlane(0.2))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    sample_share: Array | float = traced(0.98)
    prior_error_share: Array | float = traced(0.25)
    width_start: Array | float = traced(0.3)
    width_end: Array | float = traced(0.06)
    tolerance: Array | float = traced(1e-4)
    min_overlap: Array | float = traced(0.1)

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
        check_shares(self, "sample_share")
        check_not_negative(self, "prior_error_share")
        if isinstance(self.prior, GivenParticles):
            self.prior.check_number(self.num_prior, "num_prior")

    @property
    def most_look_ups(self) -> int:
        """Closest points looked up for each source point where never sure."""
        drawn = self.num_prior * (self.prior_steps + 1)
        if self._settles:
            drawn = most_look_ups(self.num_prior, self.prior_steps, self.batch_size)
        return drawn + self.num_particles * self.num_times * (self.inner_steps + 1)

    @property
    def _settles(self) -> bool:
        """Whether it may be sure early: chance is known of bounded energies only."""
        return self.num_agreeing > 0 and self.energy.resolution > 0

    def search(self, key: Key, problem: Problem, init: Motion | None) -> Found:
        """The filter (PF paper, section 4.2)."""
        d, dtype = problem.source.shape[0], problem.source.dtype
        key_prior, key_loop = jax.random.split(key)
        T = self._start(key_prior, self.num_prior, init, dtype, d)
        optimiser = self._optimiser(dtype)
        drawn = self._draw(problem, optimiser, T)

        def body(carry: _Carry) -> _Carry:
            key = jax.random.fold_in(key_loop, carry.time)
            particles = self._advance(key, problem, optimiser, carry)
            live = jnp.arange(T.shape[0]) < self.num_particles
            error = jnp.where(live[:, None], jnp.abs(particles.motion_error), 0)
            # Negated: an error that is not a number has not died.
            moving = ~(jnp.max(error) <= self.tolerance)
            trace = with_row(carry.trace, particles, self._width(carry.time, dtype))
            particles = _remembered(particles, carry.time)
            return _Carry(particles, carry.time + 1, moving, trace)

        trace = no_rows(self.num_times + 1, dtype)
        trace = with_row(trace, drawn.particles, self._width(0, dtype))
        end = lax.while_loop(
            lambda c: c.moving & (c.time <= self.num_times),
            body,
            _Carry(drawn.particles, jnp.ones((), jnp.int32), ~drawn.sure, trace),
        )
        particles = end.particles.rows(slice(self.num_particles))
        steps = self.prior_steps + (end.time - 1) * self.inner_steps
        if self._settles:
            particles = _either(drawn, particles)
            steps = steps + SETTLE_STEPS
        return Found(particles, steps, ~end.moving, end.trace)

    def _draw(
        self, problem: Problem, optimiser: LocalOptimiser, T: Float[Array, "p D D"]
    ) -> Drawn:
        """The prior at t = 0, measured and weighed."""
        start, end = (jnp.asarray(x) for x in (self.width_start, self.width_end))
        batch = min(self.batch_size, self.num_prior)
        if self._settles:
            drawn = draw_until_sure(
                problem,
                optimiser,
                self.energy,
                T,
                (start, end),
                num=self.num_prior,
                num_steps=self.prior_steps,
                num_agreeing=self.num_agreeing,
                batch_size=batch,
            )
        else:
            particles = measure(
                problem,
                optimiser,
                self.energy,
                Particles.at(T, self.num_prior),
                T,
                (start, start),
                num_rows=self.num_prior,
                num_steps=self.prior_steps,
                batch_size=batch,
            )
            none = particles.rows(slice(0))
            drawn = Drawn(particles, none, none.energy, jnp.asarray(False))
        particles = self._weighed(problem, drawn.particles, self.num_prior)
        error = self.prior_error_share * particles.motion_error
        particles = eqx.tree_at(lambda p: p.motion_error, particles, error)
        if self.dynamics.needs_path:
            path = Particles.at(T, self.num_prior, self.num_times + 1).path
            particles = eqx.tree_at(
                lambda p: p.path, particles, path, is_leaf=lambda x: x is None
            )
        particles = _remembered(particles, jnp.zeros((), jnp.int32))
        return eqx.tree_at(lambda d: d.particles, drawn, particles)

    def _advance(
        self, key: Key, problem: Problem, optimiser: LocalOptimiser, carry: _Carry
    ) -> Particles:
        """Resample, predict, measure, weigh.

        Resampling opens a step, so that the last particles keep their weights.
        """
        particles, time = carry.particles, carry.time
        key_resample, key_predict = jax.random.split(key)
        rows, log_weight = self.resampler(
            key_resample,
            particles.log_weight,
            jnp.asarray(self.num_particles),
            may_keep=(time != 1) | (self.num_prior == self.num_particles),
        )
        particles = eqx.tree_at(
            lambda p: p.log_weight, particles.rows(rows), log_weight
        )
        T_predicted = self.dynamics(key_predict, particles, time)
        width = self._width(time, T_predicted.dtype)
        num = T_predicted.shape[0]
        particles = measure(
            problem,
            optimiser,
            self.energy,
            eqx.tree_at(
                lambda p: (p.motion_error, p.energy),
                particles,
                (
                    jnp.zeros_like(particles.motion_error),
                    jnp.full(num, jnp.inf, T_predicted.dtype),
                ),
            ),
            T_predicted,
            (width, width),
            num_rows=self.num_particles,
            num_steps=self.inner_steps,
            batch_size=min(self.batch_size, self.num_prior),
        )
        return self._weighed(problem, particles, self.num_particles)

    def _width(self, time: Int[Array, ""] | int, dtype: Any) -> Scalar:
        """Kernel width at a time."""
        share = jnp.asarray(time, dtype) / self.num_times
        start = jnp.asarray(self.width_start, dtype)
        return start * (self.width_end / start) ** share

    def _weighed(self, problem: Problem, particles: Particles, num: int) -> Particles:
        """With the weights of the first `num` times their likelihoods."""
        dtype = particles.energy.dtype
        size = jnp.minimum(self.sample_share * num, self.num_particles).astype(dtype)
        points = jnp.maximum(jnp.sum(problem.source_mask), 1).astype(dtype)
        coldest = self.energy.resolution / points
        likelihood = log_likelihood(particles.energy, size, coldest)
        live = jnp.arange(particles.energy.size) < num
        return particles.weighted(normalised(particles.log_weight + likelihood, live))


def _remembered(particles: Particles, time: Int[Array, ""]) -> Particles:
    """With the motion error in the path, where one is kept."""
    if particles.path is None:
        return particles
    path = particles.path.at[:, time].set(particles.motion_error)
    return eqx.tree_at(lambda p: p.path, particles, path)


def _either(drawn: Drawn, particles: Particles) -> Particles:
    """The settled particles and those of the filter; of sure ones those that agree."""
    energy = jnp.where(drawn.sure, jnp.inf, particles.energy)
    energy = jnp.concatenate([drawn.believed, energy])
    T = [drawn.settled.T_target_source, particles.T_target_source]
    out = Particles.at(jnp.concatenate(T), len(energy))
    live = jnp.isfinite(energy)
    size = jnp.sum(live).astype(energy.dtype)
    log_weight = normalised(log_likelihood(energy, size), live)
    return eqx.tree_at(lambda p: (p.energy, p.log_weight), out, (energy, log_weight))
