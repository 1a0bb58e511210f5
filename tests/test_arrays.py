"""Rows and places in arrays against NumPy."""

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from jaxreg._core.arrays import place_among


@functools.cache
def _placed(side):
    return jax.jit(lambda ascending, wanted: place_among(ascending, wanted, side))


@pytest.mark.parametrize("side", ["left", "right"])
@given(
    st.sampled_from([1, 2, 7, 8, 9, 64]).flatmap(
        lambda n: st.lists(st.integers(-5, 5), min_size=n, max_size=n)
    ),
    st.lists(st.integers(-7, 7), min_size=6, max_size=6),
)
@settings(max_examples=60, deadline=None)
def test_places_are_those_of_searchsorted(side, values, wanted):
    ascending, wanted = np.sort(np.array(values, np.int32)), np.array(wanted, np.int32)
    place = _placed(side)(jnp.asarray(ascending), jnp.asarray(wanted))
    np.testing.assert_array_equal(place, np.searchsorted(ascending, wanted, side))
    assert place.dtype == jnp.int32
