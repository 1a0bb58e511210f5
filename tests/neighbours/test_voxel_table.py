"""The table's error bound, its candidates, and queries outside the grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clouds import M, N, clouds, compiled, distances, few, kinds, scales, seeds
from hypothesis import given
from scipy.spatial import KDTree

from jaxreg.neighbours import VoxelTable
from jaxreg.neighbours.feature_transform import feature_transform


RESOLUTION = 16
K = 4


@functools.cache
def _built(candidates: int):
    """The table and its answers."""

    def build(target, mask, queries):
        table = VoxelTable.build(
            target, mask, resolution=RESOLUTION, candidates=candidates
        )
        return table, table.query(queries)

    return jax.jit(build)


def _centres(table: VoxelTable, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and centres of the cells that answer queries, in float64."""
    origin, cell = np.asarray(table.origin, float), float(table.cell)
    at = np.clip(np.floor((points - origin) / cell), 0, RESOLUTION - 1)
    number = at @ RESOLUTION ** np.arange(points.shape[1])[::-1]
    return number.astype(int), (at + 0.5) * cell + origin


@pytest.mark.parametrize(("d", "candidates"), [(2, 1), (3, 1), (2, K), (3, K)])
def test_the_excess_stays_within_the_bound(d, candidates):
    @few
    @given(kind=kinds, seed=seeds, scale=scales)
    def check(kind, seed, scale):
        target, mask, queries = clouds(kind, seed, d, scale)
        table, found = _built(candidates)(target, mask, queries)
        row, cell = np.asarray(found.index), float(table.cell)
        assert mask[row].all()
        true = distances(target, mask, queries)
        mine = true[np.arange(N), row]
        np.testing.assert_allclose(np.sqrt(found.sq_distance), mine, rtol=1e-5)

        number, centre = _centres(table, queries.astype(float))
        rows = np.asarray(table.table).reshape(-1, candidates)[number]
        around = distances(target, mask, centre)
        first = np.take_along_axis(around, rows, 1)[:, 0]
        np.put_along_axis(around, rows, np.inf, 1)
        missed = np.min(around, axis=1)  # the closest that is not a candidate
        to_centre = np.linalg.norm(queries - centre, axis=1)
        bound = np.maximum(0, 2 * to_centre - (missed - first))
        rounding = 1e-4 * cell + 1e-6 * np.abs(queries).max() + 1e-6 * mine
        assert np.all(mine - true.min(1) <= bound + rounding)
        # Where the sweeps missed a closer point, it was not much closer.
        assert np.all(first - missed <= 1.5 * cell)
        once = np.unique(number, return_index=True)[1]  # far queries share few cells
        if len(once) > 30:
            assert np.mean(np.maximum(0, first - missed)[once]) <= 0.3 * cell

    check()


def test_more_candidates_are_nearer_the_truth():
    rng = np.random.default_rng(0)
    target = rng.standard_normal((4000, 3))
    target = (target / np.linalg.norm(target, axis=1, keepdims=True)).astype("f4")
    queries = target[:2000] + 0.05 * rng.standard_normal((2000, 3)).astype("f4")
    distance = KDTree(target).query(queries)[0]
    mask, excess, exact = np.ones(len(target), bool), [], []
    for candidates in (1, K):
        table, found = _built(candidates)(target, mask, queries)
        over = np.sqrt(np.asarray(found.sq_distance)) - distance
        excess.append(np.mean(over) / float(table.cell))
        exact.append(np.mean(over < 1e-6))
    assert excess[0] < 0.3
    assert excess[1] < 0.7 * excess[0]
    assert exact[1] > 1.5 * exact[0]


def test_lists_hold_the_points_closest_to_the_centre_once_each():
    target, mask, queries = clouds("random", 0, 3)
    table = _built(K)(target, mask, queries)[0]
    rows = np.asarray(table.table).reshape(-1, K)
    assert mask[rows].all()
    assert np.all(np.diff(np.sort(rows, axis=1), axis=1) > 0)
    corner = np.stack(np.meshgrid(*[np.arange(RESOLUTION)] * 3, indexing="ij"), -1)
    centre = (corner.reshape(-1, 3) + 0.5) * float(table.cell) + np.asarray(
        table.origin
    )
    around = distances(target, mask, centre)
    listed = np.take_along_axis(around, rows, 1)
    assert np.all(np.diff(listed, axis=1) >= -1e-6)
    right = np.all(listed <= np.sort(around, axis=1)[:, :K] + 1e-6, axis=1)
    assert np.mean(right) > 0.9


def test_the_k_nearest_candidates_are_found_and_surplus_flagged():
    target, mask, queries = clouds("random", 0, 3)
    find = compiled(VoxelTable, 3, resolution=RESOLUTION, candidates=K)
    true = distances(target, mask, queries)
    found = find(target, mask, queries)
    nearest = np.sort(true, axis=1)[:, :3]
    mine = np.take_along_axis(true, np.asarray(found.index), 1)
    np.testing.assert_allclose(np.sqrt(found.sq_distance), mine, rtol=1e-5)
    assert np.all(np.diff(mine, axis=1) >= 0)
    assert np.mean(mine <= nearest * (1 + 1e-6)) > 0.8
    # With fewer points than candidates the table is exact.
    mask &= np.cumsum(mask) <= 2
    found = find(target, mask, queries)
    np.testing.assert_array_equal(found.valid, np.arange(3) < 2 + np.zeros((N, 1)))
    expected = np.argsort(distances(target, mask, queries), axis=1)[:, :2]
    np.testing.assert_array_equal(found.index[:, :2], expected)


@pytest.mark.parametrize("candidates", [1, K])
def test_queries_outside_are_answered_from_the_nearest_cell(candidates):
    target, mask, _ = clouds("random", 0, 3)
    rng = np.random.default_rng(0)
    queries = (100 * rng.standard_normal((N, 3))).astype(np.float32)
    table, found = _built(candidates)(target, mask, queries)
    true = distances(target, mask, queries)
    mine = true[np.arange(N), np.asarray(found.index)]
    np.testing.assert_allclose(np.sqrt(found.sq_distance), mine, rtol=1e-5)
    number, _ = _centres(table, queries.astype(float))
    listed = np.asarray(table.table).reshape(-1, candidates)[number]
    assert np.all(np.any(listed == np.asarray(found.index)[:, None], axis=1))
    assert np.max(mine - true.min(1)) < np.sqrt(3) * 1.3


def test_the_grid_reaches_a_margin_beyond_the_longest_side_on_every_side():
    target, mask, _ = clouds("random", 0, 2)
    target = target * np.array([3, 1], np.float32)
    table = VoxelTable.build(jnp.asarray(target), jnp.asarray(mask), resolution=8,
                             margin=0.25)  # fmt: skip
    low, high = target[mask].min(0), target[mask].max(0)
    side = 1.5 * (high - low)[0]
    np.testing.assert_allclose(table.cell, side / 8, rtol=1e-5)
    np.testing.assert_allclose(table.origin, (low + high - side) / 2, rtol=1e-5)


@pytest.mark.parametrize("k", [1, 3])
def test_of_many_points_in_a_cell_those_nearest_its_centre_are_candidates(k):
    rng = np.random.default_rng(0)
    points = (8 * rng.random((3000, 2))).astype(np.float32)
    mask = rng.random(3000) < 0.8
    find = jax.jit(feature_transform, static_argnums=(2, 3))
    rows = np.asarray(find(jnp.asarray(points), jnp.asarray(mask), 8, k))
    centre = np.stack(np.meshgrid(*[np.arange(8) + 0.5] * 2, indexing="ij"), -1)
    around = distances(points, mask, centre.reshape(-1, 2))
    found = np.take_along_axis(around, rows.T, 1)
    np.testing.assert_allclose(found, np.sort(around, axis=1)[:, :k], rtol=1e-4)


def test_options_out_of_range_are_refused():
    points = jnp.zeros((M, 3), jnp.float32)
    with pytest.raises(ValueError, match="candidates=0"):
        VoxelTable.build(points, candidates=0)
    table = jax.eval_shape(lambda p: VoxelTable.build(p, candidates=2), points)
    with pytest.raises(
        ValueError, match=r"VoxelTable holds 2 candidates a cell, not k=3"
    ):
        table.query(points, k=3)
