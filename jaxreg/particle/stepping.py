"""A filter step by step, and the loop that a search runs it in.

    method = ParticleFilter()
    key_points, key_init, key_steps = jax.random.split(key, 3)
    filtering = method.iteration(source, target, key=key_points)
    step = eqx.filter_jit(filtering.step)
    state = filtering.init(key_init)
    for t in range(1, method.num_times + 1):
        if filtering.terminate(state):
            break
        state, info = step(jax.random.fold_in(key_steps, t), state)

`ParticleFilter.search` is this loop, compiled: who steps by hand sees what it does.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxreg._core import control
from jaxreg._core.arrays import cast_floats
from jaxreg._core.loop import AbstractIteration, Ended, iterate
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.matching import Problem
from jaxreg.particle.base import AbstractSearch
from jaxreg.particle.draw import draw_all, draw_until_sure
from jaxreg.particle.dynamics import AbstractDynamics
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.measure import measure
from jaxreg.particle.resamplers import AbstractResampler
from jaxreg.particle.state import ParticleInfo, Particles, ParticleState
from jaxreg.particle.trace import no_rows, with_row
from jaxreg.particle.weights import effective_sample_size, likelihood, normalised
from jaxreg.registrar import SearchTrace


class AbstractFilter(AbstractSearch):
    """The settings of a particle filter; see `ParticleFilter`."""

    num_prior: eqx.AbstractVar[int]
    num_particles: eqx.AbstractVar[int]
    num_times: eqx.AbstractVar[int]
    dim: eqx.AbstractVar[int | None]
    prior_steps: eqx.AbstractVar[int]
    inner_steps: eqx.AbstractVar[int]
    num_agreeing: eqx.AbstractVar[int]
    dynamics: eqx.AbstractVar[AbstractDynamics]
    resampler: eqx.AbstractVar[AbstractResampler]
    energy: eqx.AbstractVar[AbstractEnergy]
    sample_share: eqx.AbstractVar[Array | float]
    prior_error_share: eqx.AbstractVar[Array | float]
    tolerance: eqx.AbstractVar[Array | float]

    @property
    def settles(self) -> bool:
        """Whether it may be sure early: chance is known of bounded energies only."""
        return self.num_agreeing > 0 and self.energy.resolution > 0


class Filtering(eqx.Module):
    """A filter on one pair: `init`, `step` and `terminate`, as in blackjax.

    Attributes:
        method: the filter.
        problem: the pair, with the source points that particles are measured on. Poses
            in its frames are those between centred clouds whose unit is the target's
            radius; `problem.frames.leave(T)` is one between the frames of the input.
    """

    method: AbstractFilter
    problem: Problem

    @classmethod
    def of(cls, method: AbstractFilter, problem: Problem) -> "Filtering":
        """With the settings in the dtype of the problem.

        Raises: ValueError for points of a dimension that the method is not set for.
        """
        d = problem.source.shape[0]
        if method.dim not in (None, d):
            raise ValueError(
                f"{type(method).__name__}: dim: set for points of dimension "
                f"{method.dim}, found points of dimension {d}."
            )
        return cls(cast_floats(method, problem.source.dtype), problem)

    def init(self, key: Key, init: Motion | None = None) -> ParticleState:
        """The particles at t = 0: drawn from the prior, measured, weighed.

        Args:
            key: randomness.
            init: an initial guess between the frames of the input.
        """
        method, problem = self.method, self.problem
        T = method.starts(key, method.num_prior, problem, init)
        optimiser, start = method.optimiser(T.dtype), jnp.asarray(method.width_start)
        batch, settled = min(method.batch_size, method.num_prior), None
        sure = jnp.asarray(False)
        common = problem, optimiser, method.energy, T
        counts = {"num": method.num_prior, "num_steps": method.prior_steps}
        if method.settles:
            widths = start, jnp.asarray(method.width_end)
            counts["num_agreeing"] = method.num_agreeing
            drawn = draw_until_sure(*common, widths, batch_size=batch, **counts)
            particles, settled, sure = drawn.particles, drawn.settled, drawn.sure
        else:
            particles = draw_all(*common, start, batch_size=batch, **counts)
        particles, evidence = self._weighed(particles, method.num_prior)
        error = method.prior_error_share * particles.motion_error
        particles = eqx.tree_at(lambda p: p.motion_error, particles, error)
        if method.dynamics.needs_path:
            path = Particles.at(T, method.num_prior, method.num_times + 1).path
            particles = eqx.tree_at(
                lambda p: p.path, particles, path, is_leaf=lambda x: x is None
            )
        zero = jnp.zeros((), jnp.int32)
        particles = particles.remembered(zero)
        return ParticleState(particles, zero, sure, evidence, settled)

    def step(
        self, key: Key, state: ParticleState
    ) -> tuple[ParticleState, ParticleInfo]:
        """The particles of the next time: resampled, predicted, measured, weighed.

        Resampling opens a step, so that the last particles keep their weights.

        Args:
            key: randomness, another one at each time.
            state: of `init`, or of the last step.
        """
        method, problem = self.method, self.problem
        time, num = state.num_steps + 1, method.num_particles
        key_resample, key_predict = jax.random.split(key)
        particles, ancestors = method.resampler(
            key_resample,
            state.particles,
            num,
            may_keep=(time != 1) | (method.num_prior == num),
        )
        told = particles.told(state.particles)
        T_predicted = method.dynamics(key_predict, told, time)
        width = self.width(time)
        particles = measure(
            problem,
            method.optimiser(T_predicted.dtype),
            method.energy,
            particles.unmeasured(),
            T_predicted,
            (width, width),
            num_rows=num,
            num_steps=method.inner_steps,
            batch_size=min(method.batch_size, method.num_prior),
        )
        particles, evidence = self._weighed(particles, num)
        live = jnp.arange(len(ancestors)) < num
        moved = jnp.max(jnp.where(live[:, None], jnp.abs(particles.motion_error), 0))
        info = ParticleInfo(
            ancestors=ancestors[:num],
            log_evidence=evidence,
            effective_sample_size=effective_sample_size(particles.log_weight),
            moved=moved,
        )
        state = ParticleState(
            particles.remembered(time),
            time,
            moved <= method.tolerance,
            state.log_evidence + evidence,
            state.settled,
        )
        return state, info

    def scan(
        self, key: Key, init: Motion | None = None
    ) -> tuple[ParticleState, ParticleInfo]:
        """All steps to t = `num_times`, none of which ends the filter, by one scan.

        `log_evidence` of the state is the estimate of the marginal likelihood
        log p(z_0, .., z_t) = sum_t log p(z_t | z_0, .., z_t-1) (Doucet, Johansen 2009,
        section 4): what settings may be learned by, with the temperature of the
        likelihoods in mind (see `ParticleInfo.log_evidence`).

        Args:
            key: as of the search, which takes the same steps where `num_agreeing` and
                `tolerance` are zero.
            init: as of `init`.

        Returns:
            The last state, and what was told of the steps, rows by time; all particles
            of the prior are drawn, and none is settled.

        Gradients: in forward and reverse mode, by the points, by `init` and by the
        numbers of the filter and its parts, but for those that choose (`tolerance`,
        `threshold`): through the steps of the local optimiser with the closest points
        held, the energies and the learned temperature, to first order. With `Transport`
        nothing else is left out; with `Soft` which copies are drawn; with the others
        also the weights before resampling (see `AbstractHardResampler`). Held matches
        matter to what sends particles elsewhere: of a small filter with `Transport` the
        mean slopes of 2,000 keys by widths, the energy and `sample_share` are 1 to 9 %
        from differences of means by 20 %, that by the scale of the diffusion is 0.6 and
        those by spreads of the prior are 0.2 to 0.3 of theirs; with `Systematic` a
        slope of the latter has the wrong sign.
        """
        method = dataclasses.replace(self.method, num_agreeing=0)
        filtering = Filtering(method, self.problem)
        key_init, key_steps = jax.random.split(key)

        @jax.checkpoint
        def step(
            state: ParticleState, time: Int[Array, ""]
        ) -> tuple[ParticleState, ParticleInfo]:
            return filtering.step(jax.random.fold_in(key_steps, time), state)

        times = jnp.arange(1, method.num_times + 1)
        return control.scan(step, filtering.init(key_init, init), times)

    def terminate(self, state: ParticleState) -> Bool[Array, ""]:
        """Whether no particle's motion error exceeds the tolerance."""
        return state.at_rest

    def width(self, time: Int[Array, ""]) -> Scalar:
        """Kernel width at a time, from `width_start` to `width_end`."""
        method = self.method
        start = jnp.asarray(method.width_start)
        share = time.astype(start.dtype) / method.num_times
        return start * (method.width_end / start) ** jnp.minimum(share, 1)

    def _weighed(self, particles: Particles, num: int) -> tuple[Particles, Scalar]:
        """With the weights of the first `num` times their likelihoods; the evidence."""
        method, problem = self.method, self.problem
        dtype = particles.energy.dtype
        size = jnp.minimum(method.sample_share * num, method.num_particles)
        size = size.astype(dtype)
        points = jnp.maximum(jnp.sum(problem.source_mask), 1).astype(dtype)
        found = likelihood(particles.energy, size, method.energy.resolution / points)
        before, live = particles.log_weight, jnp.arange(particles.energy.size) < num
        log_weight = normalised(before + found.relative, live)
        return particles.weighted(log_weight), found.log_mean(before)


class _Run(NamedTuple):
    """A state and how the filter came to it."""

    state: ParticleState
    trace: SearchTrace

    @property
    def num_steps(self) -> Int[Array, ""]:
        """Of the state."""
        return self.state.num_steps


class _Running(AbstractIteration[tuple[Key, Motion | None], _Run]):
    """The steps of a filter with keys of their own, and a trace."""

    filtering: Filtering
    key: Key

    def init(self, start: tuple[Key, Motion | None]) -> _Run:
        state = self.filtering.init(*start)
        num = self.filtering.method.num_times + 1
        return self._traced(state, no_rows(num, state.log_evidence.dtype))

    def step(self, state: _Run) -> _Run:
        key = jax.random.fold_in(self.key, state.num_steps + 1)
        return self._traced(self.filtering.step(key, state.state)[0], state.trace)

    def terminate(self, state: _Run) -> Bool[Array, ""]:
        return self.filtering.terminate(state.state)

    def fail(self, state: _Run) -> Bool[Array, ""]:
        return jnp.asarray(False)

    def _traced(self, state: ParticleState, trace: SearchTrace) -> _Run:
        width = self.filtering.width(state.num_steps)
        return _Run(state, with_row(trace, state.particles, width))


def run(filtering: Filtering, key: Key, init: Motion | None) -> Ended[_Run]:
    """From t = 0 until the filter terminates or t = `num_times`."""
    key_init, key_steps = jax.random.split(key)
    running = _Running(filtering, key_steps)
    begin = running.init((key_init, init))
    return iterate(running, begin, max_steps=filtering.method.num_times)
