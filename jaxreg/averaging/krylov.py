"""Preconditioned conjugate gradients.

lineax's solver gives NaN in float32 from some thousand unknowns on: its guard against
vanishing curvature grows with their number. Here such a direction ends the search.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


_Linear = Callable[[Array], Array]


class _State(NamedTuple):
    x: Array
    r: Array
    p: Array
    rz: Array
    step: Array


def conjugate_gradients(
    apply: _Linear,
    precondition: _Linear,
    rhs: Float[Array, "v k"],
    *,
    columns: bool,
    tolerance: float | Array,
    max_steps: int,
) -> tuple[Float[Array, "v k"], Int[Array, ""]]:
    """Solves `apply(x) = rhs` for a positive semidefinite map and a rhs in its range.

    Args:
        apply: the map.
        precondition: about its inverse, positive semidefinite.
        rhs: the right-hand side.
        columns: True if the map treats the k columns alike and apart, so that each has
            its own steps; False if it mixes them.
        tolerance: stop when the residual, in the norm of the preconditioner, is below
            this share of its first value.
        max_steps: largest number of steps.

    Returns:
        The solution and the number of steps.
    """
    axis = 0 if columns else None
    z = precondition(rhs)
    rz = jnp.sum(rhs * z, axis=axis)
    stop = jnp.maximum(tolerance**2 * rz, jnp.finfo(rhs.dtype).tiny)

    def unfinished(s: _State) -> Array:
        return jnp.any(s.rz > stop) & (s.step < max_steps)

    def step(s: _State) -> _State:
        Ap = apply(s.p)
        pAp = jnp.sum(s.p * Ap, axis=axis)
        alive = (pAp > 0) & (s.rz > stop)
        a = jnp.where(alive, s.rz / jnp.where(alive, pAp, 1), 0)
        x, r = s.x + a * s.p, s.r - a * Ap
        z = precondition(r)
        rz = jnp.where(alive, jnp.sum(r * z, axis=axis), 0)
        beta = jnp.where(alive, rz / jnp.where(alive, s.rz, 1), 0)
        return _State(x, r, z + beta * s.p, rz, s.step + 1)

    begin = _State(jnp.zeros_like(rhs), rhs, z, rz, jnp.asarray(0, jnp.int32))
    end = jax.lax.while_loop(unfinished, step, begin)
    return end.x, end.step
