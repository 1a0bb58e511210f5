"""Fewer steps where they shrink slowly: Aitken's extrapolation along the last step.

Closest points hold a pose back: it creeps, each step a nearly constant share of the one
before. If the share is s, all that is still to come is s / (1 - s) of the step (Aitken
1926, On Bernoulli's numerical solution of algebraic equations; of ICP's steps Pavlov et
al. 2018, AA-ICP, take several).
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.typing import Motion
from jaxreg.geometry.lie import tangent_dim
from jaxreg.local.steps import decoupled_error, turn_and_shift


# Steps that shrink faster end soon by themselves, and those that hardly shrink tell
# nothing of the end: then no more than four steps more.
_FAST, _SLOW = 0.3, 0.8


def settled(
    move: Callable[[Motion, Int[Array, ""]], Motion],
    T_target_source: Motion,
    *,
    least: int,
    most: int,
    tolerance: float,
) -> Motion:
    """The pose after steps until one is small, in radians and radii.

    Args:
        move: a step from a pose, and its number.
        T_target_source: the first pose.
        least: steps before any is called small or extrapolated.
        most: steps at most.
        tolerance: what is small.
    """

    def unfinished(state: tuple[Array, ...]) -> Bool[Array, ""]:
        _, number, _, change = state
        return (number < most) & ((number < least) | (change > tolerance))

    def body(state: tuple[Array, ...]) -> tuple[Array, ...]:
        T, number, before, _ = state
        after = move(T, number)
        change = jnp.max(jnp.abs(decoupled_error(after, T)))
        before = jnp.where(number < least, 0, before)
        after, step = extrapolated(T, after, before)
        return after, number + 1, step, change

    T, dtype = T_target_source, T_target_source.dtype
    none = jnp.zeros(tangent_dim(len(T) - 1), dtype)
    start = T, jnp.zeros((), jnp.int32), none, jnp.asarray(jnp.inf, dtype)
    return control.while_loop(unfinished, body, start)[0]


def extrapolated(
    T_before: Motion, T_after: Motion, step_before: Float[Array, " k"]
) -> tuple[Motion, Float[Array, " k"]]:
    """The pose that a step leads to in the end, and the step, for the next call.

    Args:
        T_before: the pose before a step.
        T_after: the pose after it.
        step_before: what the last call gave; at first, or to leave the pose, zero.

    Returns:
        `T_after` or a pose farther on; the step, `(v, w)` of `turn_and_shift`, or zero
        after an extrapolation, for of what follows that the share is not known.
    """
    step = decoupled_error(T_after, T_before)
    tiny = jnp.finfo(step.dtype).tiny
    share = jnp.sum(step * step_before) / jnp.maximum(jnp.sum(step_before**2), tiny)
    share = jnp.where(share > _FAST, jnp.minimum(share, _SLOW), 0)
    T = turn_and_shift(T_after, share / (1 - share) * step)
    return T, jnp.where(share > 0, 0, step)
