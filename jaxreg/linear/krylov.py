"""Preconditioned conjugate gradients.

lineax's solver gives NaN in float32 from some thousand unknowns on: its guard against
vanishing curvature grows with their number. Here such a direction ends the search.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control


_Linear = Callable[[Array], Array]


class _State(NamedTuple):
    x: Array
    r: Array
    p: Array
    Ap: Array
    curvature: Array
    rz: Array
    stop: Array
    step: Array


def conjugate_gradients(
    apply: _Linear,
    precondition: _Linear,
    rhs: Float[Array, "v k c"],
    *,
    tolerance: float | Array,
    max_steps: int,
    energy: float | Array = 0.0,
) -> tuple[Float[Array, "v k c"], Int[Array, ""]]:
    """Solves `apply(x) = rhs` for a positive semidefinite map and a rhs in its range.

    Directions are made conjugate to the last one explicitly, so that the preconditioner
    may itself be an iteration, not quite linear.

    Args:
        apply: the map; treats the c columns alike and apart.
        precondition: about its inverse, positive semidefinite.
        rhs: right-hand sides; each has its own steps.
        tolerance: the last step is the one before which the residual, in the norm of
            the preconditioner, is below this share of its first value.
        max_steps: largest number of steps.
        energy: the same, before which the squared residual in that norm is below: what
            x' apply(x) about lacks.

    Returns:
        The solutions and the number of steps.
    """

    def dot(a: Array, b: Array) -> Array:
        return jnp.sum(a * b, axis=(0, 1))

    def unfinished(s: _State) -> Array:
        return jnp.any(s.rz > s.stop) & (s.step < max_steps)

    def step(s: _State) -> _State:
        z = precondition(s.r)
        rz = dot(s.r, z)
        enough = jnp.maximum(tolerance**2 * rz, energy)
        stop = jnp.where(s.step == 0, enough, s.stop)
        curved = s.curvature > 0
        beta = jnp.where(curved, -dot(z, s.Ap) / jnp.where(curved, s.curvature, 1), 0)
        p = z + beta[None, None] * s.p
        Ap = apply(p)
        curvature = dot(p, Ap)
        alive = (curvature > 0) & (rz > 0) & (s.rz > s.stop)
        a = jnp.where(alive, rz / jnp.where(alive, curvature, 1), 0)[None, None]
        rz = jnp.where(alive, rz, 0)
        return _State(s.x + a * p, s.r - a * Ap, p, Ap, curvature, rz, stop, s.step + 1)

    zero, none = jnp.zeros_like(rhs), jnp.zeros(rhs.shape[-1:], rhs.dtype)
    begin = _State(
        zero, rhs, zero, zero, none, none + jnp.inf, none, jnp.asarray(0, jnp.int32)
    )
    end = control.while_loop(unfinished, step, begin)
    return end.x, end.step
