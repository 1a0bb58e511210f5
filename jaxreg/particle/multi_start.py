"""`MultiStart`: many local descents, all kept. What the filter is measured against."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxreg._core import control
from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts
from jaxreg._core.shares import shared
from jaxreg._core.typing import Key, Motion
from jaxreg.local import AbstractStep, GaussNewton, decoupled_error
from jaxreg.matching import LIKELY, AbstractResidual, PointToPlane, Problem, match
from jaxreg.neighbours import IndexBuilder
from jaxreg.particle.base import AbstractSearch
from jaxreg.particle.candidates import Found
from jaxreg.particle.energies import AbstractEnergy, BoundedEnergy
from jaxreg.particle.priors import AbstractPrior, GivenParticles
from jaxreg.particle.state import Particles
from jaxreg.robust import AbstractKernel, GemanMcClure


class MultiStart(AbstractSearch):
    """Global registration by descents from poses drawn from the prior.

    The parts are those of `ParticleFilter`, without resampling and dynamics, and the
    end is the same: distinct modes, refined and scored. One search looks up
    `num_points * num_starts * (num_steps + 1)` closest points, by default exactly as
    many as `ParticleFilter()`.

    Attributes:
        num_starts: poses drawn from the prior.
        num_steps: local steps from each.
        refine_steps, num_points, num_modes, max_points, batch_size: as in
            `ParticleFilter`.
        num_proposals: as there, but none by default.
        prior, energy, residual, kernel, step, index: as there. The energy ranks the
            ends, of which a mode's weight is its share.
        width_start, width_end: kernel width at the first and at the last step.
        tolerance: converged where the last step turns none by more than so many radians
            and shifts none by more than so many radii (the target's root mean square
            radius).
        min_log_evidence: of less `log_evidence` than this the status is LOW_OVERLAP. At
            the default 269 of 280 right answers were believed and none of 128 wrong
            ones, but of views of walls 127 right and 6 wrong ones
            (bench/studies/evidence.md).

    Raises: ValueError while constructing, for counts that leave nothing to do.

    Fails: as `ParticleFilter`.

    Gradients: of the poses by every point of both clouds, by the balance of pulls at
    the last steps (implicit function theorem), in forward and reverse mode; held is
    what `ICP` holds. The last steps are few: on noisy clouds of 300 points slopes agree
    with differences of 1e-7 to 5 %, and to 1e-6 with ten times as many steps. Nothing
    else has an influence on where pulls balance; of which poses are found, of scores
    and covariances nothing is followed. Poses of all statuses have finite gradients.
    Without refinement asking for them raises a TypeError.
    """

    num_starts: int = eqx.field(default=672, static=True)
    num_steps: int = eqx.field(default=27, static=True)
    refine_steps: int = eqx.field(default=24, static=True)
    num_points: int = eqx.field(default=400, static=True)
    num_modes: int = eqx.field(default=16, static=True)
    num_proposals: int = eqx.field(default=0, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    prior: AbstractPrior | None = None
    energy: AbstractEnergy = eqx.field(default_factory=BoundedEnergy)
    residual: AbstractResidual = eqx.field(default_factory=lambda: PointToPlane(0.2))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)
    step: AbstractStep = eqx.field(default_factory=GaussNewton)
    index: IndexBuilder | None = eqx.field(default=None, static=True)
    width_start: Array | float = traced(0.3)
    width_end: Array | float = traced(0.06)
    tolerance: Array | float = traced(1e-4)
    min_log_evidence: Array | float = traced(LIKELY)

    def __check_init__(self) -> None:
        """Refuses counts that leave nothing to do."""
        check_counts(self, num_starts=1, num_steps=1)
        if isinstance(self.prior, GivenParticles):
            self.prior.check_number(self.num_starts, "num_starts")

    def search(self, key: Key, problem: Problem, init: Motion | None) -> Found:
        """Descends from every start, the width falling to `width_end`."""
        dtype = problem.source.dtype
        T = self.starts(key, self.num_starts, problem, init)
        optimiser = self.optimiser(dtype)
        share = jnp.linspace(0, 1, self.num_steps, dtype=dtype)
        widths = self.width_start * (self.width_end / self.width_start) ** share

        def one(T: Array) -> tuple[Array, Array, Array]:
            def step(carry: tuple[Array, Array], width: Array) -> tuple:
                T, _ = carry
                return (optimiser(problem, T, width), T), None

            T, T_before = control.scan(step, (T, T), widths)[0]
            return (
                T,
                decoupled_error(T, T_before),
                self.energy(match(problem, T), widths[-1]),
            )

        batch = min(self.batch_size, self.num_starts)
        blocks = T.reshape(-1, batch, *T.shape[1:])
        ends = lax.map(lambda T: shared(jax.vmap(one), T), blocks)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), ends)
        found = jax.tree.map(lambda x: x[: self.num_starts], flat)
        particles = eqx.tree_at(
            lambda p: (p.T_target_source, p.motion_error, p.energy),
            Particles.at(T[: self.num_starts], self.num_starts),
            found,
        )
        finished = jnp.max(jnp.abs(particles.motion_error)) <= self.tolerance
        steps = jnp.asarray(self.num_steps, jnp.int32)
        return Found(particles, steps, finished, jnp.asarray(False))
