"""The measurement of a particle: a few steps of a local optimiser, then an energy."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Scalar
from jaxreg.local import LocalOptimiser, Problem, decoupled_error, match
from jaxreg.particle.state import Particles


def energy(problem: Problem, T_target_source: Motion, width: Scalar) -> Scalar:
    """1 - mean of agreement / (1 + r^2 / width^2), in [0, 1].

    Bounded, as partial overlap needs it: points of the source without a counterpart
    cost one, however far away they are.
    """
    found = match(problem, T_target_source)
    support = found.agreement / (1 + found.sq_residual / width**2)
    total = jnp.maximum(jnp.sum(problem.source_mask), 1).astype(support.dtype)
    return 1 - jnp.sum(support) / total


def measure(
    problem: Problem,
    optimiser: LocalOptimiser,
    T_predicted: Float[Array, "p D D"],
    width: Scalar,
    *,
    num_steps: int,
    batch_size: int,
) -> Particles:
    """Runs the local optimiser on every particle (PF paper, section 3.3, steps 1, 2).

    Args:
        problem: the pair.
        optimiser: residual x kernel x step.
        T_predicted: predicted poses.
        width: kernel width of optimiser and energy.
        num_steps: the paper's R.
        batch_size: particles in one vectorised block.
    """
    widths = jnp.full(num_steps, width)

    def one(T: Array) -> Particles:
        T_measured = optimiser.repeat(problem, T, widths)
        error = decoupled_error(T_measured, T)
        return Particles(T_measured, error, energy(problem, T_measured, width))

    return lax.map(one, T_predicted, batch_size=min(batch_size, T_predicted.shape[0]))
