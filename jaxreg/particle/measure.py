"""The measurement of a particle: a few steps of a local optimiser, then an energy."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
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
    num_rows: Int[Array, ""] | int,
    num_steps: Int[Array, ""] | int,
    batch_size: int,
) -> Particles:
    """Runs the local optimiser on particles (PF paper, section 3.3, steps 1, 2).

    Args:
        problem: the pair.
        optimiser: residual x kernel x step.
        T_predicted: predicted poses; `batch_size` divides their number.
        width: kernel width of optimiser and energy.
        num_rows: how many of them to measure, rounded up to full blocks; the energy of
            the others is inf.
        num_steps: the paper's R.
        batch_size: particles in one vectorised block.
    """

    def one(T: Array) -> Particles:
        T_measured = lax.fori_loop(
            0, num_steps, lambda _, T: optimiser(problem, T, width), T
        )
        error = decoupled_error(T_measured, T)
        return Particles(T_measured, error, energy(problem, T_measured, width))

    def block(b: Array, out: Particles) -> Particles:
        rows = b * batch_size + jnp.arange(batch_size)
        found = jax.vmap(one)(T_predicted[rows])
        return jax.tree.map(lambda all_, new: all_.at[rows].set(new), out, found)

    p, D = T_predicted.shape[:2]
    zero = jnp.zeros((p, lie.tangent_dim(D - 1)), T_predicted.dtype)
    start = Particles(T_predicted, zero, jnp.full(p, jnp.inf, zero.dtype))
    return lax.fori_loop(0, -(-num_rows // batch_size), block, start)
