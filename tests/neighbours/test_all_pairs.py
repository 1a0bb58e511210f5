"""What indexes do on an accelerator: the same answers, traced for one and run here."""

import jax
import numpy as np
import pytest
from clouds import M, N, clouds, distances, few, kinds, scales, seeds
from hypothesis import given
from hypothesis import strategies as st

from jaxreg._core.platforms import traced_for
from jaxreg.neighbours import BoxTree, BruteForce, CellGrid


PLATFORMS = "cpu", "gpu"


def found_on(platform, index, k, target, mask, queries):
    def find(target, mask, queries):
        with traced_for(platform):
            return index.build(target, mask).query(queries, k)

    return jax.jit(find)(target, mask, queries)


@pytest.mark.parametrize("k", [1, 5, 20])
@pytest.mark.parametrize("index", [BruteForce, BoxTree])
def test_accelerators_find_the_closest_points(index, k):
    run = jax.jit(lambda *x: found_on("gpu", index, k, *x))

    @few
    @given(kind=kinds, seed=seeds, scale=scales, num=st.sampled_from([0, 1, 3, M]))
    def check(kind, seed, scale, num):
        target, mask, queries = clouds(kind, seed, 3, scale)
        mask &= np.cumsum(mask) <= num
        found = run(target, mask, queries)
        have = min(mask.sum(), k)
        valid = np.reshape(found.valid, (N, k))
        np.testing.assert_array_equal(valid, np.arange(k) < have + np.zeros((N, 1)))
        true = distances(target, mask, queries)
        rows = np.reshape(found.index, (N, k))[:, :have]
        mine = np.take_along_axis(true, rows, 1)
        np.testing.assert_allclose(mine, np.sort(true, axis=1)[:, :have], rtol=1e-6)
        assert np.all(np.diff(np.sort(rows, axis=1), axis=1) > 0)

    check()


@pytest.mark.parametrize("k", [1, 5, 20])
def test_ties_go_to_the_same_rows_on_both(k):
    rng = np.random.default_rng(0)
    target = rng.integers(0, 4, (M, 3)).astype(np.float32)
    queries = rng.integers(0, 4, (N, 3)).astype(np.float32)
    mask = rng.random(M) < 0.7
    here, there = (found_on(p, BruteForce, k, target, mask, queries) for p in PLATFORMS)
    np.testing.assert_array_equal(here.index, there.index)


def test_cells_find_the_same_on_both():
    rng = np.random.default_rng(0)
    target = rng.normal(size=(3000, 3)).astype(np.float32)
    target /= np.linalg.norm(target, axis=1, keepdims=True)
    queries = target + rng.normal(size=target.shape).astype(np.float32) * 0.01
    mask = np.ones(3000, bool)
    here, there = (found_on(p, CellGrid, 1, target, mask, queries) for p in PLATFORMS)
    np.testing.assert_array_equal(here.valid, there.valid)
    np.testing.assert_array_equal(here.index[here.valid], there.index[here.valid])
