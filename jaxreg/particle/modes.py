"""Distinct poses among particles."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.particle.state import Particles


def distinct_modes(
    particles: Particles,
    num_modes: int,
    last: Bool[Array, " p"] | None = None,
    *,
    angle: Scalar,
    distance: Scalar,
) -> tuple[Int[Array, " q"], Float[Array, " q"]]:
    """Rows of the best particles that differ from one another, and their weights.

    Greedy: the particle of least energy is a mode and takes the weight of all
    particles within `angle` (radians) and `distance` of it; then the next among the
    rest. Surplus modes have weight zero and repeat the first row. Those of `last` come
    after all others.
    """
    T = particles.T_target_source
    R, t = lie.rotation(T), lie.translation(T)
    weight = jnp.exp(particles.log_weight)

    def pick(free: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        first = free if last is None else free & ~last
        first = jnp.where(jnp.any(first), first, free)
        best = jnp.argmin(jnp.where(first, particles.energy, jnp.inf))
        turn = lie.rotation_angle(jnp.einsum("pij,kj->pik", R, R[best]))
        shift = jnp.sqrt(jnp.sum((t - t[best][None]) ** 2, axis=-1))
        same = free & (turn < angle) & (shift < distance)
        # A mode in use has a weight, though that of its particles may underflow.
        tiny = jnp.finfo(weight.dtype).tiny
        mass = jnp.maximum(jnp.sum(jnp.where(same, weight, 0)), tiny)
        return free & ~same, (best, jnp.where(jnp.any(free), mass, 0))

    free = jnp.isfinite(particles.energy) & (particles.log_weight > -jnp.inf)
    _, (rows, mass) = control.scan(pick, free, None, length=num_modes)
    return jnp.where(mass > 0, rows, rows[0]).astype(jnp.int32), mass


def first_within(
    T: Float[Array, "q D D"], *, angle: Scalar, distance: Scalar
) -> Int[Array, " q"]:
    """The first row within `angle` (radians) and `distance` of each; itself if none."""
    R, t = lie.rotation(T), lie.translation(T)
    turn = lie.rotation_angle(jnp.einsum("pij,qkj->pqik", R, R))
    shift = jnp.sqrt(jnp.sum((t[:, None] - t[None]) ** 2, axis=-1))
    # Of NaN nothing is within reach, not even itself.
    near = (turn < angle) & (shift < distance) | jnp.eye(len(T), dtype=bool)
    return jnp.argmax(near, axis=1).astype(jnp.int32)
