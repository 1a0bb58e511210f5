"""The quantile by bisection against a sort in NumPy."""

import math
from fractions import Fraction

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from jaxreg._core.quantile import masked_quantile, nearest_rank


N = 23
DTYPES = [np.float32, np.float64]
_quantile = jax.jit(masked_quantile)


def _oracle(x: np.ndarray, mask: np.ndarray, share: float) -> float:
    valid = np.sort(x[mask])
    if valid.size == 0:
        return 0.0
    # The share is a float: a hair above an integer counts as that integer.
    rank = math.ceil(Fraction(share) * valid.size * (1 - Fraction(1, 10**6)))
    return valid[max(rank, 1) - 1]


def _values(dtype):
    wide = st.floats(
        0, 2.0**100, width=32 if dtype == np.float32 else 64, allow_subnormal=False
    )
    few = st.sampled_from([0.0, -0.0, 1.0, 2.5, np.inf])
    return hnp.arrays(dtype, N, elements=st.one_of(wide, few))


@pytest.mark.parametrize("dtype", DTYPES)
def test_it_is_the_order_statistic_of_the_valid_values(dtype):
    @settings(max_examples=150, deadline=None)
    @given(
        x=_values(dtype),
        mask=hnp.arrays(bool, N),
        share=st.one_of(
            st.sampled_from([0.0, 1 / 3, 0.1, 0.5, 0.7, 1.0]),
            st.fractions(0, 1, max_denominator=1000).map(float),
        ),
    )
    def check(x, mask, share):
        found = _quantile(jnp.asarray(x), jnp.asarray(mask), jnp.asarray(share, dtype))
        assert found.dtype == dtype
        assert float(found) == float(_oracle(x, mask, share))

    with jax.enable_x64(True):
        check()


def test_one_share_of_the_values_does_not_exceed_it():
    x = np.random.default_rng(0).gamma(0.3, size=(4, 1000)).astype(np.float32)
    mask = np.random.default_rng(1).random((4, 1000)) < 0.8
    found = jax.vmap(lambda x, m: masked_quantile(x, m, 0.25))(x, mask)
    for row, valid, value in zip(x, mask, np.asarray(found), strict=True):
        kept = row[valid]
        assert value in kept
        assert np.mean(kept <= value) >= 0.25 > np.mean(kept < value)


def test_values_that_are_masked_may_be_anything():
    x = jnp.asarray([3.0, jnp.nan, -1.0, 1.0, jnp.inf], jnp.float32)
    mask = jnp.asarray([True, False, False, True, False])
    assert float(masked_quantile(x, mask, 0.5)) == 1
    assert float(masked_quantile(x, mask, 1.0)) == 3
    assert float(masked_quantile(x, mask & False, 0.5)) == 0


def test_its_gradient_is_that_of_the_value_that_it_is():
    x = jnp.asarray([3.0, 1.0, 2.0])
    slope = jax.grad(lambda x: masked_quantile(x, x > 1, 0.5) ** 2 * x[0])(x)
    np.testing.assert_array_equal(slope, [4, 0, 12])
    nothing = jax.grad(lambda x: masked_quantile(x, x > 9, 0.5))(x)
    np.testing.assert_array_equal(nothing, 0)


@pytest.mark.parametrize("q", [0.0, 0.25, 0.5, 0.98, 1.0])
def test_nearest_ranks_run_from_the_least_value_to_the_greatest(q):
    x = np.random.default_rng(0).permutation(N).astype(np.float32)
    for count in (0, 1, 2, 7, N):
        mask = np.arange(N) < count
        valid = np.sort(x[:count])
        wanted = valid[math.floor(q * (count - 1) + 0.5)] if count else 0
        assert nearest_rank(jnp.asarray(x), jnp.asarray(mask), q) == wanted
