"""The measurement of a particle: a few steps of a local optimiser, then an energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Scalar
from jaxreg.local import LocalOptimiser, Problem, decoupled_error, match
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.state import Particles


def measure(
    problem: Problem,
    optimiser: LocalOptimiser,
    energy: AbstractEnergy,
    particles: Particles,
    T_predicted: Float[Array, "p D D"],
    width: Scalar,
    *,
    num_rows: Int[Array, ""] | int,
    num_steps: Int[Array, ""] | int,
    batch_size: int,
) -> Particles:
    """Runs the local optimiser on particles (PF paper, section 3.3, steps 1, 2).

    Args:
        problem: the pair.
        optimiser: residual x kernel x step.
        energy: of the poses that it leads to.
        particles: their poses, motion errors and energies are replaced.
        T_predicted: `(p, d+1, d+1)` poses to start from; `batch_size` divides p.
        width: kernel width of optimiser and energy.
        num_rows: how many of them to measure, rounded up to full blocks; the energy of
            the others is inf and their motion error zero.
        num_steps: the paper's R.
        batch_size: particles in one vectorised block.
    """

    def one(T: Array) -> tuple[Array, Array, Array]:
        T_measured = lax.fori_loop(
            0, num_steps, lambda _, T: optimiser(problem, T, width), T
        )
        error = decoupled_error(T_measured, T)
        return T_measured, error, energy(match(problem, T_measured), width)

    def block(b: Array, out: tuple[Array, ...]) -> tuple[Array, ...]:
        rows = b * batch_size + jnp.arange(batch_size)
        found = jax.vmap(one)(T_predicted[rows])
        return jax.tree.map(lambda all_, new: all_.at[rows].set(new), out, found)

    fresh = Particles.at(T_predicted, T_predicted.shape[0])
    start = (T_predicted, fresh.motion_error, fresh.energy)
    found = lax.fori_loop(0, -(-num_rows // batch_size), block, start)
    return eqx.tree_at(
        lambda p: (p.T_target_source, p.motion_error, p.energy), particles, found
    )
