"""Resampling: numbers of copies, and when to resample."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.particle import Multinomial, Residual, Stratified, Systematic


P, NUM, DRAWS = 12, 8, 6000
ALL = [Systematic, Stratified, Multinomial, Residual]
# Two rows without weight: rows out of use.
WEIGHT = np.array([0.3, 0.2, 0.15, 0.1, 0.08, 0.07, 0.05, 0.03, 0.015, 0.005, 0, 0])


@functools.cache
def _copies(kind) -> np.ndarray:
    """`(draws, p)` copies of each row among the first NUM of a draw."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    weight = jnp.asarray(WEIGHT, jnp.float32)
    rows = jax.jit(jax.vmap(lambda k: kind().draw(k, weight, jnp.asarray(NUM))))(keys)
    return np.stack([np.sum(np.asarray(rows)[:, :NUM] == i, 1) for i in range(P)], 1)


@pytest.mark.parametrize("kind", ALL)
def test_copies_are_unbiased(kind):
    copies = _copies(kind)
    np.testing.assert_array_equal(copies.sum(1), NUM)
    error = np.sqrt(NUM * WEIGHT * (1 - WEIGHT) / DRAWS)
    assert np.all(np.abs(copies.mean(0) - NUM * WEIGHT) <= 5 * error + 1e-6)
    assert np.all(copies[:, WEIGHT == 0] == 0)


def test_variances_of_the_copies_are_those_of_the_definitions():
    share = NUM * WEIGHT
    whole = np.floor(share)
    part, left = share - whole, NUM - whole.sum()
    expected = {
        # Between floor and ceiling with the mean right: a Bernoulli number.
        Systematic: part * (1 - part),
        Multinomial: share * (1 - WEIGHT),
        Residual: part * (1 - part / left),
    }
    for kind, variance in expected.items():
        np.testing.assert_allclose(_copies(kind).var(0), variance, atol=0.06)
    stratified = _copies(Stratified)
    assert np.all(np.abs(stratified - share) < 2)
    assert np.all(_copies(Residual) >= whole)
    assert stratified.var(0).sum() < _copies(Multinomial).var(0).sum()


@pytest.mark.parametrize("kind", ALL)
def test_resampling_takes_place_below_the_threshold_only(kind):
    log_weight = jnp.log(jnp.asarray(WEIGHT, jnp.float32))
    share = 1 / np.sum(WEIGHT**2) / 10
    call = functools.partial(kind.__call__, key=jax.random.key(1), num=10)
    place = np.arange(P)
    for threshold, may_keep, kept in [
        (share - 0.01, True, True),
        (share + 0.01, True, False),
        (share - 0.01, False, False),
        (0.0, True, True),
        (1.0, True, False),
    ]:
        rows, after = call(
            kind(threshold), log_weight=log_weight, may_keep=jnp.asarray(may_keep)
        )
        assert np.array_equal(rows[:10], place[:10]) == kept
        expected = log_weight if kept else np.where(place < 10, -np.log(10), -np.inf)
        np.testing.assert_allclose(after, expected, rtol=1e-6)
    # One or more is always, also where all weights are equal.
    equal = jnp.where(place < 10, -jnp.log(10.0), -jnp.inf)
    _, after = call(kind(1.0), log_weight=equal, may_keep=True)
    np.testing.assert_allclose(after, equal, rtol=1e-6)


def test_a_negative_threshold_is_refused():
    with pytest.raises(ValueError, match=r"Residual.*threshold.*-0\.5"):
        Residual(-0.5)
