"""Draws from the prior until the answer is sure: t = 0 of the particle filter.

Particles are drawn and measured in groups. The best of each group are settled: measured
again by more steps, the kernel width falling, so that those that reached the same pose
have the same energy. The answer is sure as soon as several of them agree on the pose of
least energy and every settled particle elsewhere is worse by more than chance: a
sequential test (Wald 1945). An object that looks the same from two sides keeps finding
two poses, and a wrong pose is rarely found twice, so both go on to the filter.

The constants were chosen on pairs of real scans, horses, boxes and cylinders.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.loop import AbstractIteration, iterate
from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.local import LocalOptimiser
from jaxreg.matching import Problem
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.measure import measure
from jaxreg.particle.state import Particles
from jaxreg.particle.weights import likelihood, normalised


# Blocks in a group; one of them is settled.
_BLOCKS = 4
# Steps with falling width.
SETTLE_STEPS = 16
# Settled particles within this, in radians and radii, agree; farther apart than that,
# they are rivals.
_SAME, _APART = 0.1, 0.3
# Differences of the mean energy of n points, in 1 / sqrt(n): none, and no chance.
_EQUAL, _WORSE = 0.6, 2.0


class Drawn(eqx.Module):
    """Particles of the prior.

    Attributes:
        particles: all that were asked for, measured; energy inf where not drawn.
        settled: the best of each group; energy inf likewise, and where they are sure
            also for all that did not settle at the best pose.
        sure: whether the settled agree.
    """

    particles: Particles
    settled: Particles
    sure: Bool[Array, ""]


def most_look_ups(num: int, num_steps: int, batch_size: int) -> int:
    """Closest points that drawing looks up for each source point where never sure."""
    group, groups = _groups(num, batch_size)
    settled = groups * group // _BLOCKS
    return groups * group * (num_steps + 1) + settled * (SETTLE_STEPS + 1)


def _groups(num: int, batch_size: int) -> tuple[int, int]:
    """Poses in a group and groups, of `num` poses in blocks of at most that many."""
    group = _BLOCKS * min(batch_size, -(-num // _BLOCKS))
    return group, -(-num // group)


def draw_all(
    problem: Problem,
    optimiser: LocalOptimiser,
    energy: AbstractEnergy,
    T: Float[Array, "p D D"],
    width: Scalar,
    *,
    num: int,
    num_steps: int,
    batch_size: int,
) -> Particles:
    """Measures the first `num` poses, as in the paper; see `draw_until_sure`."""
    return measure(
        problem,
        optimiser,
        energy,
        Particles.at(T, num),
        T,
        (width, width),
        num_rows=num,
        num_steps=num_steps,
        batch_size=batch_size,
    )


def draw_until_sure(
    problem: Problem,
    optimiser: LocalOptimiser,
    energy: AbstractEnergy,
    T: Float[Array, "p D D"],
    widths: tuple[Scalar, Scalar],
    *,
    num: int,
    num_steps: int,
    num_agreeing: int,
    batch_size: int,
) -> Drawn:
    """Measures and settles poses, group by group.

    Args:
        problem: the pair.
        optimiser: residual x kernel x step.
        energy: bounded, see `BoundedEnergy`.
        T: `(p, d+1, d+1)` poses of the prior, of which the first `num` count.
        widths: kernel width of the measurement, and at the end of settling.
        num: poses to draw at most.
        num_steps: of the measurement.
        num_agreeing: settled particles that must agree.
        batch_size: particles in one vectorised block, at most.
    """
    group, groups = _groups(num, batch_size)
    drawing = _Drawing(
        problem, optimiser, energy, widths, num, num_steps, num_agreeing, group
    )
    drawn = groups * group
    rows = jnp.arange(drawn + drawn // _BLOCKS) % len(T)
    begin = drawing.init(Particles.at(T[rows], num))
    ended = iterate(drawing, begin, max_steps=groups)
    particles, sure = ended.state.particles, ended.converged
    # As many rows as there were poses, also where that is more than were to be drawn.
    row = jnp.arange(len(T))
    first = particles.rows(jnp.minimum(row, drawn - 1))
    first = first.valued(jnp.where(row < num, first.energy, jnp.inf))
    settled = particles.rows(slice(drawn, None))
    away = sure & ~_near(settled, jnp.argmin(settled.energy), _APART)
    settled = settled.valued(jnp.where(away, jnp.inf, settled.energy))
    return Drawn(first, settled, sure)


class _Draws(NamedTuple):
    particles: Particles
    sure: Bool[Array, ""]
    num_steps: Int[Array, ""]  # groups


class _Drawing(AbstractIteration[Particles, _Draws]):
    """Groups in turn: measured, and the best of each settled, until they agree.

    The particles are those to draw, in groups, and behind them a block for the settled
    of each group. `num` of those to draw count; the others fill the last group.
    """

    problem: Problem
    optimiser: LocalOptimiser
    energy: AbstractEnergy
    widths: tuple[Scalar, Scalar]
    num: int = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    num_agreeing: int = eqx.field(static=True)
    group: int = eqx.field(static=True)

    def init(self, start: Particles) -> _Draws:
        return _Draws(start, jnp.asarray(False), jnp.asarray(0, jnp.int32))

    def terminate(self, state: _Draws) -> Bool[Array, ""]:
        return state.sure

    def fail(self, state: _Draws) -> Bool[Array, ""]:
        return jnp.asarray(False)

    def step(self, state: _Draws) -> _Draws:
        """With the next group measured, and the best of it settled."""
        number = state.num_steps

        def phase(which: Array, particles: Particles) -> Particles:
            return self._phase(which == 1, number, particles)

        # One loop compiles the measurement once.
        particles = control.fori_loop(0, 2, phase, state.particles)
        settled = particles.rows(slice(self._drawn(particles), None))
        points = jnp.maximum(jnp.sum(self.problem.source_mask), 1)
        points = points.astype(particles.energy.dtype)
        sure = _agree(settled, self.num_agreeing, points)
        return _Draws(particles, sure, number + 1)

    def _drawn(self, particles: Particles) -> int:
        return particles.energy.size * _BLOCKS // (_BLOCKS + 1)

    def _phase(
        self, settling: Bool[Array, ""], number: Int[Array, ""], particles: Particles
    ) -> Particles:
        block = self.group // _BLOCKS
        drawn = self._drawn(particles)
        group, home = number * self.group, drawn + number * block
        measured = lax.dynamic_slice_in_dim(particles.energy, group, self.group)
        best = lax.top_k(-measured, block)[1]
        T = particles.T_target_source
        start = lax.dynamic_update_slice_in_dim(T, T[group + best], home, 0)
        first, last = self.widths
        out = measure(
            self.problem,
            self.optimiser,
            self.energy,
            particles,
            start,
            (first, jnp.where(settling, last, first)),
            first_row=jnp.where(settling, home, group),
            num_rows=jnp.where(settling, block, self.group),
            num_steps=jnp.where(settling, SETTLE_STEPS, self.num_steps),
            batch_size=block,
        )
        row = jnp.arange(out.energy.size)
        counts = (row < self.num) | (row >= drawn)
        energy = jnp.where(counts & jnp.isfinite(out.energy), out.energy, jnp.inf)
        # A block is settled in full, also where fewer were drawn.
        settled = lax.dynamic_slice_in_dim(energy, home, block)
        surplus = settling & jnp.isinf(measured[best])
        settled = jnp.where(surplus, jnp.inf, settled)
        return out.valued(lax.dynamic_update_slice_in_dim(energy, settled, home, 0))


def with_settled(
    settled: Particles, particles: Particles, sure: Bool[Array, ""]
) -> Particles:
    """The settled particles and those of the filter; of sure ones those that agree."""
    energy = jnp.where(sure, jnp.inf, particles.energy)
    energy = jnp.concatenate([settled.energy, energy])
    T = [settled.T_target_source, particles.T_target_source]
    out = Particles.at(jnp.concatenate(T), len(energy))
    live = jnp.isfinite(energy)
    size = jnp.sum(live).astype(energy.dtype)
    log_weight = normalised(likelihood(energy, size).relative, live)
    return eqx.tree_at(lambda p: (p.energy, p.log_weight), out, (energy, log_weight))


def _agree(
    settled: Particles, num_agreeing: int, points: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether so many agree on the best pose and none is nearly as good elsewhere."""
    best = jnp.argmin(settled.energy)
    excess = (settled.energy - settled.energy[best]) * jnp.sqrt(points)
    same = _near(settled, best, _SAME) & (excess < _EQUAL)
    rival = ~_near(settled, best, _APART) & (excess < _WORSE)
    return (jnp.sum(same) >= num_agreeing) & ~jnp.any(rival)


def _near(particles: Particles, row: Int[Array, ""], limit: float) -> Bool[Array, " p"]:
    """Which are within so many radians and radii of one of them."""
    R = lie.rotation(particles.T_target_source)
    t = lie.translation(particles.T_target_source)
    turn = lie.rotation_angle(jnp.einsum("pij,kj->pik", R, R[row]))
    return (turn < limit) & (
        jnp.sqrt(jnp.sum((t - t[row][None]) ** 2, axis=-1)) < limit
    )
