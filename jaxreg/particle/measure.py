"""The measurement of a particle: a few steps of a local optimiser, then an energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.shares import shared
from jaxreg._core.typing import Scalar
from jaxreg.local import LocalOptimiser, decoupled_error
from jaxreg.matching import Problem, match
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.state import Particles


def measure(
    problem: Problem,
    optimiser: LocalOptimiser,
    energy: AbstractEnergy,
    particles: Particles,
    T_predicted: Float[Array, "p D D"],
    widths: tuple[Scalar, Scalar],
    *,
    num_rows: Int[Array, ""] | int,
    num_steps: Int[Array, ""] | int,
    batch_size: int,
    first_row: Int[Array, ""] | int = 0,
) -> Particles:
    """Runs the local optimiser on particles (PF paper, section 3.3, steps 1, 2).

    Args:
        problem: the pair.
        optimiser: residual x kernel x step.
        energy: of the poses that it leads to.
        particles: the motion errors and energies of those measured are replaced.
        T_predicted: `(p, d+1, d+1)` poses to start from, which replace theirs;
            `batch_size` divides p.
        widths: kernel width of the first step and of the last, which is the energy's.
        num_rows: how many of them to measure, rounded up to full blocks.
        num_steps: the paper's R.
        batch_size: particles in one vectorised block.
        first_row: of those to measure.
    """
    first, last = widths

    def one(T: Array) -> tuple[Array, Array, Array]:
        @jax.checkpoint  # backwards a step is matched again, not remembered
        def step(i: Array, T: Array) -> Array:
            share = i / jnp.maximum(num_steps - 1, 1)
            width = first * (last / first) ** share.astype(T.dtype)
            return optimiser(problem, T, width)

        T_measured = control.fori_loop(0, num_steps, step, T)
        error = decoupled_error(T_measured, T)
        return T_measured, error, energy(match(problem, T_measured), last)

    def block(b: Array, out: tuple[Array, ...]) -> tuple[Array, ...]:
        rows = first_row + b * batch_size + jnp.arange(batch_size)
        found = shared(jax.vmap(one), T_predicted[rows])
        return jax.tree.map(lambda all_, new: all_.at[rows].set(new), out, found)

    start = (T_predicted, particles.motion_error, particles.energy)
    found = control.fori_loop(0, -(-num_rows // batch_size), block, start)
    return eqx.tree_at(
        lambda p: (p.T_target_source, p.motion_error, p.energy), particles, found
    )
