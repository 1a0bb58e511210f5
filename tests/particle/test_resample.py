import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.particle.resample import (
    effective_sample_size,
    systematic,
    tempered_weights,
)


P = 64


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.1, 0.9))
def test_weights_have_the_effective_sample_size_asked_for(seed, share):
    energy = jnp.asarray(np.random.default_rng(seed).random(P), jnp.float32)
    weight = tempered_weights(energy, share * P)
    assert float(jnp.sum(weight)) == pytest.approx(1, abs=1e-4)
    assert float(effective_sample_size(weight)) == pytest.approx(share * P, rel=0.02)
    order = np.argsort(energy)
    assert np.all(np.diff(np.asarray(weight)[order]) <= 1e-7)


@pytest.mark.parametrize("value", [0.3, np.inf, np.nan])
def test_equal_or_infinite_energies_give_uniform_weights(value):
    weight = tempered_weights(jnp.full(P, value, jnp.float32), P / 2)
    np.testing.assert_allclose(weight, 1 / P, rtol=1e-5)


def test_particles_of_infinite_energy_get_no_weight():
    energy = jnp.linspace(0, 1, P).at[3].set(jnp.inf).at[5].set(jnp.nan)
    weight = np.asarray(tempered_weights(energy, P / 2))
    assert weight[3] == weight[5] == 0
    assert weight.sum() == pytest.approx(1, abs=1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_systematic_copies_each_particle_its_share_rounded(seed):
    rng = np.random.default_rng(seed)
    weight = rng.random(P) ** 4
    weight /= weight.sum()
    rows = systematic(jax.random.key(seed), jnp.asarray(weight, jnp.float32), P // 2)
    copies = np.bincount(np.asarray(rows)[: P // 2], minlength=P)
    share = P // 2 * weight
    assert np.all(copies >= np.floor(share - 1e-3))
    assert np.all(copies <= np.ceil(share + 1e-3))


def test_systematic_is_unbiased():
    weight = jnp.asarray([0.07, 0.23, 0.7])
    keys = jax.random.split(jax.random.key(0), 4000)
    rows = jax.vmap(lambda k: systematic(k, weight, 3))(keys)
    share = np.bincount(np.asarray(rows).ravel(), minlength=3) / rows.size
    np.testing.assert_allclose(share, weight, atol=0.01)
