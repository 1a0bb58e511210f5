"""Every index against SciPy's k-d tree in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from jaxreg.neighbours import BruteForce, VoxelTable


M, N = 300, 200


def _shape(kind: str, rng: np.random.Generator, d: int) -> np.ndarray:
    x = rng.random((M, d))
    if kind == "clustered":
        x = x**4
    elif kind == "duplicated":
        x = x[rng.integers(0, M // 3, M)]
    elif kind == "collinear":
        x = x[:, :1] * np.ones(d)
    elif kind == "far":
        x = x + 1e3
    return x


kinds = st.sampled_from(["random", "clustered", "duplicated", "collinear", "far"])


@pytest.mark.parametrize("d", [2, 3])
def test_brute_force_is_exact(d):
    query = jax.jit(lambda p, m, q: BruteForce.build(p, m).query(q))

    @settings(max_examples=25, deadline=None)
    @given(
        kind=kinds, seed=st.integers(0, 10**6), scale=st.sampled_from([1e-6, 1, 1e6])
    )
    def check(kind, seed, scale):
        rng = np.random.default_rng(seed)
        target = (scale * _shape(kind, rng, d)).astype(np.float32)
        queries = (scale * (_shape(kind, rng, d)[:N] + 0.1)).astype(np.float32)
        mask = rng.random(M) < 0.7
        mask[0] = True
        found = query(target, mask, queries)
        distance = KDTree(target[mask].astype(float)).query(queries.astype(float))[0]
        row = np.asarray(found.index)
        assert mask[row].all()
        mine = np.linalg.norm(queries.astype(float) - target[row].astype(float), axis=1)
        # Equal up to the rounding of a squared float32 distance.
        np.testing.assert_allclose(mine, distance, rtol=1e-6, atol=1e-9 * scale)

    check()


def test_brute_force_breaks_ties_by_the_lowest_row_and_tiles_large_targets():
    rng = np.random.default_rng(0)
    base = rng.random((5000, 3)).astype(np.float32)
    target = np.concatenate([base, base])  # several tiles, every point twice
    found = BruteForce.build(jnp.asarray(target)).query(jnp.asarray(base[::7]))
    np.testing.assert_array_equal(found.index, np.arange(5000)[::7])
    np.testing.assert_array_equal(found.sq_distance, 0)


def test_brute_force_in_float64():
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        target = 1e6 + rng.random((M, 3))
        queries = 1e6 + rng.random((N, 3))
        found = BruteForce.build(jnp.asarray(target)).query(jnp.asarray(queries))
        np.testing.assert_array_equal(found.index, KDTree(target).query(queries)[1])


@pytest.mark.parametrize("d", [2, 3])
def test_voxel_table_stays_within_its_bound(d):
    query = jax.jit(lambda p, m, q: (VoxelTable.build(p, m, resolution=32)).query(q))

    @settings(max_examples=20, deadline=None)
    @given(
        kind=kinds, seed=st.integers(0, 10**6), scale=st.sampled_from([1e-3, 1, 1e3])
    )
    def check(kind, seed, scale):
        rng = np.random.default_rng(seed)
        target = (scale * _shape(kind, rng, d)).astype(np.float32)
        inside = rng.integers(0, M, N)
        queries = target[inside] + 0.05 * scale * rng.standard_normal((N, d))
        queries = queries.astype(np.float32)
        mask = rng.random(M) < 0.7
        mask[0] = True
        found = query(target, mask, queries)
        assert mask[np.asarray(found.index)].all()
        distance = KDTree(target[mask]).query(queries)[0]
        low, high = target[mask].min(0), target[mask].max(0)
        side = max(np.max(high - low), 1e-12) if mask.sum() > 1 else 1
        side = side if side > 1e-6 * scale else 1
        cell = 1.2 * side / 32
        excess = np.sqrt(np.asarray(found.sq_distance)) - distance
        # One cell diagonal, twice for cells that the sweeps did not settle.
        outside = np.any((queries < low) | (queries > high), axis=1)
        assert np.all(excess[~outside] <= 2 * np.sqrt(d) * cell + 1e-6 * scale)
        assert np.mean(excess[~outside] > np.sqrt(d) * cell) < 0.02

    check()


def test_voxel_table_answers_far_queries_with_their_true_distance():
    rng = np.random.default_rng(0)
    target = rng.random((M, 3)).astype(np.float32)
    queries = (100 * rng.standard_normal((N, 3))).astype(np.float32)
    table = VoxelTable.build(jnp.asarray(target), resolution=32)
    found = table.query(jnp.asarray(queries))
    own = np.linalg.norm(queries - target[np.asarray(found.index)], axis=1)
    np.testing.assert_allclose(np.sqrt(found.sq_distance), own, rtol=1e-5)
    assert np.max(own - KDTree(target).query(queries)[0]) < np.sqrt(3) * 1.3


@pytest.mark.parametrize("index", [BruteForce, VoxelTable])
def test_no_valid_target_is_flagged(index):
    points = jnp.ones((10, 3))
    found = index.build(points, jnp.zeros(10, bool)).query(points)
    assert not found.valid.any()
    assert np.all(np.asarray(found.index) < 10)


@pytest.mark.parametrize("index", [BruteForce, VoxelTable])
def test_vmap_equals_the_loop(index):
    rng = np.random.default_rng(0)
    target = jnp.asarray(rng.random((3, 50, 3)), jnp.float32)
    queries = jnp.asarray(rng.random((3, 40, 3)), jnp.float32)

    def nearest(p, q):
        return index.build(p).query(q).index

    batched = jax.vmap(nearest)(target, queries)
    for k in range(3):
        np.testing.assert_array_equal(batched[k], nearest(target[k], queries[k]))
