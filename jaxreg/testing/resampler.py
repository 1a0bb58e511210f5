"""The promises of a resampler."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.particle import AbstractResampler
from jaxreg.testing.promises import promise, promise_traced_numbers


_NUM, _DRAWS = 8, 6000
# Two rows without weight: rows out of use.
_WEIGHT = np.array([0.3, 0.2, 0.15, 0.1, 0.08, 0.07, 0.05, 0.03, 0.015, 0.005, 0, 0])


def check_resampler(resampler: AbstractResampler) -> None:
    """Draws eight ancestors of ten particles, 6000 times.

    Promised are: int32 rows; as many copies of each as its share, on average (within
    five standard errors), and none of a row without weight; that particles stay as long
    as their effective sample size is above the threshold, and weigh the same after.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(resampler)
    name = type(resampler).__name__
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
    _promise_threshold(name, resampler)


def _promise_threshold(name: str, resampler: AbstractResampler) -> None:
    threshold = float(jnp.asarray(resampler.threshold))
    place, used = np.arange(len(_WEIGHT)), 10
    for weight, may_keep in ((_WEIGHT, True), (_WEIGHT, False), (_WEIGHT > 0, True)):
        weight = weight / np.sum(weight)
        size = 1 / np.sum(weight**2) / used
        kept = may_keep and threshold < 1 and size >= threshold
        log_weight = jnp.log(jnp.asarray(weight, jnp.float32))
        rows, after = resampler(jax.random.key(1), log_weight, used, may_keep)
        if kept:
            promise(
                np.array_equal(rows, place),
                f"{name}: particles above the threshold are replaced.",
            )
        equal = np.where(place < used, -np.log(used), -np.inf)
        wanted = np.asarray(log_weight) if kept else equal
        promise(
            np.allclose(after, wanted, rtol=1e-5),
            f"{name}: weights after it are not {'those before' if kept else 'equal'}.",
        )
