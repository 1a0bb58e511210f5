"""Clouds that are hard to search, against NumPy in float64."""

import jax
import numpy as np
import pytest
from clouds import M, N, clouds, compiled, distances, few, kinds, scales, seeds
from hypothesis import given

from jaxreg.neighbours import (
    BoxTree,
    BruteForce,
    CellGrid,
    VoxelTable,
)


EXACT = [BruteForce, BoxTree]
INDEXES = [*EXACT, VoxelTable, CellGrid]
OPTIONS = {VoxelTable: {"resolution": 16}, CellGrid: {"radius": 0.5}}


def _compiled(index):
    return compiled(index, **OPTIONS.get(index, {}))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("index", EXACT)
def test_the_closest_point_is_found(index, d):
    @few
    @given(kind=kinds, seed=seeds, scale=scales)
    def check(kind, seed, scale):
        target, mask, queries = clouds(kind, seed, d, scale)
        found = _compiled(index)(target, mask, queries)
        row = np.asarray(found.index)
        assert mask[row].all()
        assert np.asarray(found.valid).all()
        true = distances(target, mask, queries)
        mine = true[np.arange(N), row]
        # Up to the rounding of a squared float32 distance.
        np.testing.assert_allclose(mine, true.min(1), rtol=1e-6)
        np.testing.assert_allclose(np.sqrt(found.sq_distance), mine, rtol=1e-6)

    check()


@pytest.mark.parametrize("kind", ["random", "duplicated", "collinear"])
def test_the_tree_finds_the_k_closest_points(kind):
    target, mask, queries = clouds(kind, 0, 3)
    found = compiled(BoxTree, k=7)(target, mask, queries)
    true = np.sort(distances(target, mask, queries), axis=1)[:, :7]
    mine = np.linalg.norm(queries[:, None] - target[np.asarray(found.index)], axis=2)
    assert mask[np.asarray(found.index)].all()
    np.testing.assert_allclose(mine, true, rtol=1e-4, atol=1e-6)
    rows = np.sort(found.index, axis=1)
    assert (np.diff(rows, axis=1) > 0).all()  # no point twice
    few = compiled(BoxTree, k=7)(target, np.arange(M) < 4, queries)
    np.testing.assert_array_equal(np.asarray(few.valid).sum(1), 4)


@pytest.mark.parametrize("index", EXACT)
def test_the_closest_point_is_found_in_float64(index):
    with jax.enable_x64(True):
        target, mask, queries = clouds("offset", 0, 3, dtype=np.float64)
        found = _compiled(index)(target, mask, queries)
        expected = distances(target, mask, queries).argmin(1)
        np.testing.assert_array_equal(found.index, expected)
        assert found.sq_distance.dtype == np.float64
        assert found.index.dtype == np.int32


@pytest.mark.parametrize("index", INDEXES)
def test_a_radius_flags_what_is_farther(index):
    target, mask, queries = clouds("random", 0, 3)
    for radius in (0.05, 0.1):
        found = _compiled(index)(target, mask, queries, radius)
        mine = distances(target, mask, queries)[np.arange(N), np.asarray(found.index)]
        np.testing.assert_array_equal(found.valid, mine <= radius)
        assert 0 < np.sum(found.valid) < N


def test_a_k_that_cannot_be_answered_is_refused():
    points = np.zeros((4, 3), np.float32)
    with pytest.raises(ValueError, match=r"k must be at least 1, got k=0"):
        jax.eval_shape(lambda x: BruteForce.build(x).query(x, k=0), points)
    with pytest.raises(ValueError, match=r"CellGrid finds .* \(k=1\), not k=2"):
        jax.eval_shape(lambda x: CellGrid.build(x, radius=1.0).query(x, k=2), points)
