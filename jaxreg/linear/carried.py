"""Velocities and forces of rigid bodies, carried from one point to another.

A velocity is a translation, that of the body's point which is there, and a turn; a
force and its torque answer to it. Far from where a body is, both parts are about the
same number, and single precision tells them apart no more.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.linear.small import cross


def carried(x: Float[Array, "*b k c"], shift: Float[Array, "*b d"]) -> Array:
    """The velocities C x at points `shift` further, each column by itself."""
    d = shift.shape[-1]
    lever, turn = shift[..., None], x[..., d:, :]
    if d == 3:
        moved = cross(turn, lever, axis=-2)
    else:
        moved = turn * jnp.concatenate([-lever[..., 1:, :], lever[..., :1, :]], axis=-2)
    return jnp.concatenate([x[..., :d, :] + moved, turn], axis=-2)


def carried_back(force: Float[Array, "*b k c"], shift: Float[Array, "*b d"]) -> Array:
    """The forces C' f at points from where `shift` leads to those of `force`."""
    d = shift.shape[-1]
    lever, push = shift[..., None], force[..., :d, :]
    if d == 3:
        torque = cross(lever, push, axis=-2)
    else:
        torque = lever[..., :1, :] * push[..., 1:, :]
        torque = torque - lever[..., 1:, :] * push[..., :1, :]
    return jnp.concatenate([push, force[..., d:, :] + torque], axis=-2)


def stiffness_carried_back(
    weight: Float[Array, "*b k k"], shift: Float[Array, "*b d"]
) -> Float[Array, "*b k k"]:
    """C' W C: the stiffness W seen from points from where `shift` leads to its own."""
    half = carried_back(weight, shift)
    return carried_back(jnp.swapaxes(half, -1, -2), shift)
