"""Log weights and likelihoods whose temperature is learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.particle.weights import effective_sample_size, likelihood, normalised


P = 64
LIKELIHOOD = jax.jit(lambda *args: likelihood(*args).relative)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.1, 0.9))
def test_likelihoods_have_the_effective_sample_size_asked_for(seed, share):
    energy = np.random.default_rng(seed).random(P).astype(np.float32)
    log_p = np.asarray(LIKELIHOOD(jnp.asarray(energy), share * P), np.float64)
    w = np.exp(log_p) / np.exp(log_p).sum()
    assert 1 / np.sum(w**2) == pytest.approx(share * P, rel=0.02)
    assert float(effective_sample_size(jnp.asarray(log_p - 7))) == pytest.approx(
        1 / np.sum(w**2), rel=1e-3
    )
    # -energy / temperature: a line with a negative slope.
    slope = np.polyfit(energy, log_p, 1)
    assert slope[0] < 0
    np.testing.assert_allclose(np.polyval(slope, energy), log_p, atol=1e-3)
    assert log_p.max() == 0


def test_energies_nearer_than_the_coldest_temperature_are_nearly_equal():
    energy = jnp.asarray(np.linspace(0, 1e-3, P), jnp.float32)
    weight = np.exp(LIKELIHOOD(energy, P / 2, 0.01))
    np.testing.assert_allclose(weight, 1, atol=0.1)


@pytest.mark.parametrize("value", [0.3, np.inf, np.nan])
def test_equal_or_infinite_energies_give_uniform_weights(value):
    log_p = likelihood(jnp.full(P, value, jnp.float32), P / 2).relative
    weight = np.exp(normalised(log_p, jnp.arange(P) < 48))
    np.testing.assert_allclose(weight[:48], 1 / 48, rtol=1e-5)
    np.testing.assert_array_equal(weight[48:], 0)


def test_particles_of_infinite_energy_get_no_weight():
    energy = jnp.linspace(0, 1, P).at[3].set(jnp.inf).at[5].set(jnp.nan)
    log_p = likelihood(energy, P / 2).relative
    weight = np.exp(normalised(log_p, jnp.ones(P, bool)))
    assert weight[3] == weight[5] == 0
    assert weight.sum() == pytest.approx(1, abs=1e-5)


def test_products_of_weights_do_not_underflow():
    # A thousand equal factors: w_t of Eq. 9 in float32.
    log_weight = jnp.asarray([-1000.0, -1001.0, -2000.0], jnp.float32)
    weight = np.exp(normalised(log_weight, jnp.ones(3, bool)))
    expected = np.exp([0.0, -1.0, -1000.0])
    np.testing.assert_allclose(weight, expected / expected.sum(), rtol=1e-5)
    none = normalised(jnp.full(3, -jnp.inf), jnp.asarray([True, True, False]))
    np.testing.assert_allclose(np.exp(none), [0.5, 0.5, 0], rtol=1e-6)


def test_the_mean_likelihood_is_that_of_all_particles_in_use():
    rng = np.random.default_rng(0)
    energy, weight = 1 + rng.random(P), rng.random(P) * (np.arange(P) % 3 > 0)
    energy[4] = np.inf
    array = jnp.asarray(energy, jnp.float32)
    found = likelihood(array, P / 2)
    low, high = np.argsort(energy)[[0, 40]]
    relative = np.asarray(found.relative, float)
    temperature = (energy[low] - energy[high]) / (relative[high] - relative[low])
    assert float(found.best) == pytest.approx(-energy[low] / temperature, rel=1e-4)
    some = (np.arange(P) != 4) & (weight > 0)
    expected = np.average(np.exp(-energy / temperature)[some], weights=weight[some])
    log_weight = jnp.where(weight > 0, jnp.log(jnp.maximum(weight, 1e-9)), -jnp.inf)
    log_mean = found.log_mean(log_weight.astype(jnp.float32))
    assert float(log_mean) == pytest.approx(np.log(expected), rel=1e-4)
