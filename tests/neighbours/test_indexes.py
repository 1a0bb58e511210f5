"""What every index promises, against NumPy in float64."""

import jax
import jax.numpy as jnp
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


pytestmark = pytest.mark.usefixtures("quickly_compiled")


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
def test_no_valid_target_is_flagged(index):
    target, mask, queries = clouds("random", 0, 3)
    found = _compiled(index)(target, np.zeros_like(mask), queries)
    assert not np.asarray(found.valid).any()
    assert np.all((np.asarray(found.index) >= 0) & (np.asarray(found.index) < M))


@pytest.mark.parametrize("index", INDEXES)
def test_queries_that_are_not_finite_are_flagged_alone(index):
    target, mask, queries = clouds("random", 0, 3)
    expected = _compiled(index)(target, mask, queries)
    broken = queries.copy()
    broken[3], broken[5, 0], broken[7, 2] = np.nan, np.inf, -np.inf
    found = _compiled(index)(target, mask, broken)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(found.valid)), [3, 5, 7])
    others = np.asarray(found.valid)
    np.testing.assert_array_equal(found.index[others], expected.index[others])
    assert np.all((np.asarray(found.index) >= 0) & (np.asarray(found.index) < M))


@pytest.mark.parametrize("index", INDEXES)
def test_targets_that_are_not_finite_are_never_found(index):
    target, mask, queries = clouds("random", 0, 3)
    mask[:] = True
    broken = target.copy()
    broken[::2] = np.nan
    broken[4, 1:], broken[6] = 0, np.inf
    found = _compiled(index)(broken, mask, queries)
    mask[::2] = False
    expected = _compiled(index)(target, mask, queries)
    np.testing.assert_array_equal(found.index, expected.index)


@pytest.mark.parametrize("index", INDEXES)
def test_the_first_queries_do_not_depend_on_how_many_are_answered(index):
    target, mask, queries = clouds("random", 0, 3)
    built = index.build(jnp.asarray(target), jnp.asarray(mask))
    columns = jnp.tile(jnp.asarray(queries), (40, 1)).T
    find = jax.jit(lambda queries, num: built.lookup(queries, num))
    some = find(columns, jnp.asarray(300))
    np.testing.assert_array_equal(some[:300], built.lookup(columns)[:300])


@pytest.mark.parametrize("index", INDEXES)
def test_vmap_equals_the_loop(index):
    sets = [clouds("random", seed, 3) for seed in range(3)]
    find = _compiled(index)
    batched = jax.jit(jax.vmap(find))(*map(np.stack, zip(*sets, strict=True)))
    for k, one in enumerate(sets):
        np.testing.assert_array_equal(batched.index[k], find(*one).index)


@pytest.mark.parametrize("index", INDEXES)
def test_a_radius_flags_what_is_farther(index):
    target, mask, queries = clouds("random", 0, 3)
    for radius in (0.05, 0.1):
        found = _compiled(index)(target, mask, queries, radius)
        mine = distances(target, mask, queries)[np.arange(N), np.asarray(found.index)]
        np.testing.assert_array_equal(found.valid, mine <= radius)
        assert 0 < np.sum(found.valid) < N


def test_squared_distances_have_gradients():
    target, mask, queries = clouds("random", 0, 3)

    def total(target, queries):
        found = BruteForce.build(target, jnp.asarray(mask)).query(queries, k=2)
        return jnp.sum(found.sq_distance), found.index

    gradient = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))
    (to_target, to_queries), row = gradient(target, queries)
    delta = 2 * (queries[:, None] - target[row])
    np.testing.assert_allclose(to_queries, delta.sum(1), rtol=1e-5, atol=1e-6)
    expected = np.zeros_like(target)
    np.add.at(expected, np.asarray(row), -delta)
    np.testing.assert_allclose(to_target, expected, rtol=1e-5, atol=1e-5)


def test_a_k_that_cannot_be_answered_is_refused():
    points = jnp.zeros((4, 3), jnp.float32)
    with pytest.raises(ValueError, match=r"k must be at least 1, got k=0"):
        BruteForce.build(points).query(points, k=0)
    with pytest.raises(ValueError, match=r"CellGrid finds .* \(k=1\), not k=2"):
        CellGrid.build(points, radius=1.0).query(points, k=2)
