"""The promises of a resampler."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.particle import AbstractHardResampler, AbstractResampler, Particles
from jaxreg.testing.problems import motion
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_rigid,
    promise_traced_numbers,
)


_NUM, _DRAWS, _FEW_DRAWS = 8, 6000, 1000
# Two rows without weight: rows out of use.
_WEIGHT = np.array([0.3, 0.2, 0.15, 0.1, 0.08, 0.07, 0.05, 0.03, 0.015, 0.005, 0, 0])
_USED = int(np.count_nonzero(_WEIGHT))


def check_resampler(resampler: AbstractResampler) -> None:
    """Makes eight particles of ten, in 2D and 3D, many times in the plane.

    Promised are: rigid poses and int32 rows; no row without weight has a part in them,
    whatever it holds; normalised weights of the first eight; weighted means that stay
    on average, within five standard errors and an eighth of a deviation; that particles
    stay as they are while their effective sample size is above the threshold; finite
    gradients of poses and weights. Of those that draw ancestors also: as many copies of
    each as its share, on average (within five standard errors), and equal weights.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(resampler)
    name = type(resampler).__name__
    if isinstance(resampler, AbstractHardResampler):
        _promise_shares(name, resampler)
    with jax.enable_x64(True):
        for d in (2, 3):
            _promise_particles(f"{name} in {d}D", resampler, d)
        _promise_means(name, resampler)
        _promise_gradients(name, resampler)
    _promise_threshold(name, resampler)


def _promise_shares(name: str, resampler: AbstractHardResampler) -> None:
    """Requires copies by share."""
    weight = jnp.asarray(_WEIGHT, jnp.float32)
    keys = jax.random.split(jax.random.key(0), _DRAWS)
    draw = jax.jit(jax.vmap(lambda k: resampler.draw(k, weight, jnp.asarray(_NUM))))
    rows = np.asarray(draw(keys))
    promise(
        rows.shape == (_DRAWS, len(_WEIGHT)) and rows.dtype == np.int32,
        f"{name}: wanted one int32 row a particle, found {rows.dtype} of shape "
        f"{rows.shape[1:]}.",
    )
    copies = np.stack([np.sum(rows[:, :_NUM] == i, 1) for i in range(len(_WEIGHT))], 1)
    promise(copies.sum(1) == _NUM, f"{name}: a row is beyond the particles.")
    promise(copies[:, _WEIGHT == 0] == 0, f"{name}: a row without weight is drawn.")
    error = np.sqrt(_NUM * _WEIGHT * (1 - _WEIGHT) / _DRAWS)
    gap = np.abs(copies.mean(0) - _NUM * _WEIGHT)
    promise(gap <= 5 * error + 1e-6, f"{name}: copies are not as many as their share.")


def _particles(d: int, weight: np.ndarray = _WEIGHT) -> Particles:
    """Poses along a path; those without weight are not numbers."""
    T = np.stack([motion(d, 0.1 * i, 0.3 * i, 0) for i in range(len(weight))])
    used = weight > 0
    T[~used] = np.nan
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight / weight.sum())
    error = np.where(used[:, None], T[:, 0, -1:] + np.ones(3 * d - 3), np.nan)
    energy = np.where(used, 1.0, np.inf)
    return Particles(*map(jnp.asarray, (T, error, energy, log_weight)))


def _promise_particles(name: str, resampler: AbstractResampler, d: int) -> None:
    """Requires particles that can be gone on with."""
    before, key = _particles(d), jax.random.key(0)
    after, rows = eqx.filter_jit(resampler.replace)(key, before, _NUM)
    shape = before.energy.shape
    promise(
        rows.shape == shape and rows.dtype == np.int32,
        f"{name}: wanted one int32 row a particle, found {rows.dtype} of {rows.shape}.",
    )
    promise(
        np.isin(rows[:_NUM], np.flatnonzero(_WEIGHT)),
        f"{name}: a row without weight has a part in a particle.",
    )
    promise_rigid(name, "path", np.asarray(after.T_target_source[:_NUM]))
    promise(
        np.isfinite(after.motion_error[:_NUM]),
        f"{name}: a row without weight has a part in a motion error.",
    )
    weight = np.exp(np.asarray(after.log_weight))
    normalised = np.isclose(weight.sum(), 1) & np.all(weight[_NUM:] == 0)
    promise(normalised, f"{name}: weights after it are not normalised.")
    for dtype in (np.float32, np.float64):
        kinds = jax.tree.map(lambda x, t=dtype: x.astype(t), before)
        out = eqx.filter_eval_shape(resampler.replace, key, kinds, _NUM)
        promise_dtypes(out, dtype, name)


def _promise_means(name: str, resampler: AbstractResampler) -> None:
    """Requires that the mean of the translations stays where it is."""
    before = _particles(2)

    def mean(key: jax.Array) -> jax.Array:
        after = resampler.replace(key, before, _NUM)[0]
        x = after.T_target_source[:_NUM, :2, 2]
        return jnp.exp(after.log_weight[:_NUM]) @ x

    keys = jax.random.split(jax.random.key(1), _FEW_DRAWS)
    found = np.asarray(jax.jit(jax.vmap(mean))(keys))
    x = np.nan_to_num(np.asarray(before.T_target_source[:, :2, 2]))
    wanted = _WEIGHT @ x
    deviation = np.sqrt(_WEIGHT @ (x - wanted) ** 2)
    error = 5 * found.std(0) / np.sqrt(_FEW_DRAWS) + deviation / _NUM
    gap = np.abs(found.mean(0) - wanted)
    promise(gap <= error, f"{name}: weighted means do not stay as they are.")


def _promise_gradients(name: str, resampler: AbstractResampler) -> None:
    """Requires gradients that are numbers, by poses and weights."""
    before, key = _particles(2), jax.random.key(0)

    def value(T: jax.Array, log_weight: jax.Array) -> jax.Array:
        moved = eqx.tree_at(
            lambda p: (p.T_target_source, p.log_weight), before, (T, log_weight)
        )
        after = resampler.replace(key, moved, _NUM)[0]
        x, level = after.T_target_source[:_NUM], after.log_weight[:_NUM]
        return jnp.sum(jnp.exp(level)[:, None, None] * x)

    args = before.T_target_source, before.log_weight
    slopes = jax.jit(jax.grad(value, (0, 1)))(*args)
    used = jax.tree.map(lambda x: x[:_USED], slopes)
    promise(
        all(bool(jnp.all(jnp.isfinite(x))) for x in used),
        f"{name}: gradients are not finite.",
    )


def _promise_threshold(name: str, resampler: AbstractResampler) -> None:
    key, call = jax.random.key(1), eqx.filter_jit(resampler.__call__)
    threshold = float(jnp.asarray(resampler.threshold))
    place = np.arange(len(_WEIGHT))
    for weight, may_keep in ((_WEIGHT, True), (_WEIGHT, False), (_WEIGHT > 0, True)):
        size = np.sum(weight) ** 2 / np.sum(weight**2) / _USED
        kept = may_keep and threshold < 1 and size >= threshold
        before = _particles(2, weight)
        out, rows = call(key, before, _USED, jnp.asarray(may_keep))
        if not kept:
            before = resampler.replace(key, before, _USED)[0]
        else:
            promise(
                np.array_equal(rows, place),
                f"{name}: particles above the threshold are replaced.",
            )
        promise(
            np.allclose(out.log_weight, before.log_weight, rtol=1e-5),
            f"{name}: weights after it are not {'those before' if kept else 'new'}.",
        )
        if isinstance(resampler, AbstractHardResampler) and not kept:
            equal = np.where(place < _USED, -np.log(_USED), -np.inf)
            promise(
                np.allclose(out.log_weight, equal, rtol=1e-5),
                f"{name}: weights after it are not equal.",
            )
