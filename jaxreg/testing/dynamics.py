"""The promises of dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.particle import AbstractDynamics, Particles
from jaxreg.testing.problems import motion
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_rigid,
    promise_traced_numbers,
)


# Five particles, and a row that is not in use; motion errors of two times, of four.
_NUM, _USED, _TIMES, _TIME = 6, 5, 4, 2


def check_dynamics(dynamics: AbstractDynamics) -> None:
    """Predicts five particles at their second time, in 2D and 3D.

    Promised are: poses that are rigid, one a particle, in the dtype of the particles;
    the poses themselves where all motion errors are zero; that a row without weight
    counts for nothing, whatever it holds; a path is needed only where `needs_path` says
    so; the same predictions by the same key, compiled and side by side with others.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(dynamics)
    name = type(dynamics).__name__
    promise(
        isinstance(dynamics.needs_path, bool),
        f"{name}: needs_path is {dynamics.needs_path!r}; wanted True or False.",
    )
    for d in (2, 3):
        with jax.enable_x64(True):
            _promise_predictions(f"{name} in {d}D", dynamics, d)


def _promise_predictions(name: str, dynamics: AbstractDynamics, d: int) -> None:
    key, time = jax.random.key(0), jnp.asarray(_TIME, jnp.int32)
    plain = _particles(d, dynamics.needs_path)
    junk = jax.tree.map(lambda x: x.at[_USED:].set(jnp.nan), plain)
    junk = eqx.tree_at(lambda p: p.log_weight, junk, plain.log_weight)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), plain, _still(plain), junk)
    found = np.asarray(_together(dynamics, key, stacked, time))[:, :_USED]
    promise_equal(found[2], found[0], f"{name}: a row without weight counts")
    for which, T in zip(("plain", "still"), found[:2], strict=True):
        promise_rigid(name, which, T)
    promise_equal(
        found[1],
        plain.T_target_source[:_USED],
        f"{name}: particles without motion errors move",
    )
    promise_equal(
        dynamics(key, plain, time)[:_USED],
        found[0],
        f"{name}: alone and side by side it does not give the same",
    )
    for dtype in (np.float32, np.float64):
        kinds = jax.tree.map(lambda x, t=dtype: x.astype(t), plain)
        out = eqx.filter_eval_shape(dynamics, key, kinds, time)
        promise_dtypes(out, dtype, name)
        shape = plain.T_target_source.shape
        promise(out.shape == shape, f"{name}: wanted poses {shape}, found {out.shape}.")


@eqx.filter_jit
def _together(
    dynamics: AbstractDynamics, key: jax.Array, particles: Particles, time: jax.Array
) -> jax.Array:
    return jax.vmap(lambda p: dynamics(key, p, time))(particles)


def _particles(d: int, with_path: bool) -> Particles:
    """Measured poses of different weights, their errors random."""
    rng, k = np.random.default_rng(0), 3 * d - 3
    T = np.stack([motion(d, 0.5 * i, 0.5, i) for i in range(_NUM)])
    path = 0.1 * rng.standard_normal((_NUM, _TIMES, k))
    path[:, _TIME:] = 0
    weight = np.where(np.arange(_NUM) < _USED, rng.uniform(0.5, 1.5, _NUM), 0)
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight / weight.sum())
    return Particles(
        jnp.asarray(T),
        jnp.asarray(path[:, _TIME - 1]),
        jnp.asarray(np.where(weight > 0, rng.uniform(size=_NUM), np.inf)),
        jnp.asarray(log_weight),
        jnp.asarray(path) if with_path else None,
    )


def _still(particles: Particles) -> Particles:
    """The same without motion errors."""
    leaves = (particles.T_target_source, particles.energy, particles.log_weight)
    zeros = jax.tree.map(jnp.zeros_like, particles)
    return eqx.tree_at(
        lambda p: (p.T_target_source, p.energy, p.log_weight), zeros, leaves
    )
