"""The oracle of the other indexes, against NumPy in float64."""

import numpy as np
import pytest
from clouds import M, N, clouds, compiled, distances, few, kinds, scales, seeds
from hypothesis import given
from hypothesis import strategies as st

from jaxreg.neighbours import BruteForce


K = 5


@pytest.mark.parametrize("d", [2, 3])
def test_the_k_closest_points_are_found(d):
    @few
    @given(kind=kinds, seed=seeds, scale=scales, num=st.sampled_from([0, 1, 3, M]))
    def check(kind, seed, scale, num):
        target, mask, queries = clouds(kind, seed, d, scale)
        mask &= np.cumsum(mask) <= num
        num = min(mask.sum(), K)
        found = compiled(BruteForce, K)(target, mask, queries)
        row, valid = np.asarray(found.index), np.asarray(found.valid)
        assert row.shape == found.sq_distance.shape == (N, K)
        np.testing.assert_array_equal(valid, np.arange(K) < num + np.zeros((N, 1)))
        np.testing.assert_array_equal(np.isinf(found.sq_distance), ~valid)
        true = distances(target, mask, queries)
        mine = np.take_along_axis(true, row[:, :num], 1)
        nearest = np.sort(true, axis=1)[:, :num]
        np.testing.assert_allclose(mine, nearest, rtol=1e-6)
        different = np.sort(row[:, :num], axis=1)
        assert np.all(np.diff(different, axis=1) > 0)

    check()


@pytest.mark.parametrize("k", [1, K])
def test_ties_go_to_the_lowest_row(k):
    rng = np.random.default_rng(0)
    # Small integers: float32 distances are exact, and many are equal.
    target = rng.integers(0, 4, (M, 3)).astype(np.float32)
    queries = rng.integers(0, 4, (N, 3)).astype(np.float32)
    mask = rng.random(M) < 0.7
    found = compiled(BruteForce, k)(target, mask, queries)
    true = distances(target, mask, queries)
    expected = np.argsort(true, axis=1, kind="stable")[:, :k]
    np.testing.assert_array_equal(np.reshape(found.index, (N, k)), expected)


def test_large_targets_and_many_queries_go_through_several_tiles():
    rng = np.random.default_rng(0)
    base = rng.random((1500, 3)).astype(np.float32)
    target = np.concatenate([base, base])  # every point twice
    found = compiled(BruteForce)(target, np.ones(3000, bool), base)
    np.testing.assert_array_equal(found.index, np.arange(1500))
    np.testing.assert_array_equal(found.sq_distance, 0)


@pytest.mark.parametrize("scale", [1e-30, 1e-25, 1e25, 1e36])
def test_squared_distances_beyond_the_float_range_do_not_matter(scale):
    target, mask, queries = clouds("random", 0, 3, scale)
    found = compiled(BruteForce)(target, mask, queries)
    true = distances(target, mask, queries)
    mine = true[np.arange(N), np.asarray(found.index)]
    np.testing.assert_allclose(mine, true.min(1), rtol=1e-6)


def test_targets_are_tied_for_a_query_too_far_away():
    target, mask, queries = clouds("random", 0, 3)
    mask[:3] = False, False, True
    found = compiled(BruteForce)(target, mask, queries + np.float32(1e30))
    np.testing.assert_array_equal(found.index, 2)
    assert np.asarray(found.valid).all()
