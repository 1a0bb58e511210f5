"""Exact within the radius, near beyond it, whatever the cells hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clouds import N, clouds, distances, few, kinds, scales, seeds
from hypothesis import given
from hypothesis import strategies as st

from jaxreg.geometry.spacing import median_spacing
from jaxreg.neighbours import BruteForce, CellGrid, index_within


@jax.jit
def _found(target, mask, queries, radius):
    grid = CellGrid.build(target, mask, radius=radius)
    far = jnp.asarray(True)
    return grid.radius, grid.query(queries), grid.lookup(queries.T, coarse=far)


@pytest.mark.parametrize("d", [2, 3])
def test_the_closest_point_within_the_radius_is_found(d):
    @few
    @given(kind=kinds, seed=seeds, scale=scales, radius=st.floats(0, 0.5))
    def check(kind, seed, scale, radius):
        target, mask, queries = clouds(kind, seed, d, scale)
        reach, found, coarse = _found(target, mask, queries, radius * scale)
        row, reach = np.asarray(found.index), float(reach)
        assert reach >= 0.999 * radius * scale
        assert mask[row].all()
        assert mask[np.asarray(coarse)].all()
        true = distances(target, mask, queries)
        mine, least = true[np.arange(N), row], true.min(1)
        near = least < reach * (1 - 1e-5)
        np.testing.assert_allclose(mine[near], least[near], rtol=1e-5)
        assert np.asarray(found.valid)[near].all()
        assert not np.asarray(found.valid)[least > reach * (1 + 1e-5)].any()
        # So few targets answer coarsely all of them, near or far.
        closest = true[np.arange(N), np.asarray(coarse)]
        np.testing.assert_allclose(closest, least, rtol=1e-5, atol=1e-6 * scale)

    check()


def test_points_far_away_cost_no_accuracy():
    target, mask, queries = clouds("random", 0, 3)
    mask[:3] = True
    target[:3] = [[1e4, 0, 0], [0, -1e6, 1e6], [1e9, 1e9, -1e9]]
    queries[:3] = target[:3] + 0.1 * np.eye(3)
    true = distances(target, mask, queries)
    reach, found, _ = _found(target, mask, queries, 0.25)
    assert float(reach) < 0.5
    near = true.min(1) < 0.25
    assert near[:3].all()
    mine = true[np.arange(N), np.asarray(found.index)]
    np.testing.assert_allclose(mine[near], true.min(1)[near], rtol=1e-5)


def test_the_radius_is_the_spacing_by_default():
    target, mask, _ = clouds("random", 0, 3)
    radius = jax.jit(lambda *cloud: CellGrid.build(*cloud).radius)(target, mask)
    spacing = median_spacing(jnp.asarray(target), jnp.asarray(mask))
    np.testing.assert_allclose(radius, spacing, rtol=1e-5)


def test_cells_serve_many_points_and_comparison_few():
    points, mask = jnp.zeros((4000, 3), jnp.float32), jnp.ones(4000, bool)
    radius = jnp.asarray(1.0)
    few = jax.eval_shape(index_within, points[:500], mask[:500], radius)
    assert isinstance(few, BruteForce)
    assert isinstance(jax.eval_shape(index_within, points, mask, radius), CellGrid)
