"""Orders of rows: by a key, and along a curve that never jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.neighbours.order import hilbert_order
from jaxreg.neighbours.sorting import rows_in_order


@pytest.mark.parametrize(("num", "bits"), [(5, 31), (1000, 31), (1000, 12), (3000, 1)])
def test_rows_are_in_the_order_of_their_keys_and_equal_keys_in_theirs(num, bits):
    rng = np.random.default_rng(num)
    key = rng.integers(0, 2**bits, num, dtype=np.int32)
    key[::3] = key[0]
    rows = jax.jit(rows_in_order, static_argnums=1)(jnp.asarray(key), bits)
    np.testing.assert_array_equal(rows, np.argsort(key, kind="stable"))


@pytest.mark.parametrize(("d", "side"), [(2, 32), (3, 16)])
def test_a_full_grid_is_walked_in_single_steps(d, side):
    grid = np.stack(np.meshgrid(*[np.arange(side)] * d, indexing="ij"), axis=-1)
    grid = grid.reshape(-1, d)
    rng = np.random.default_rng(0)
    points = rng.permutation(grid).astype(np.float32)
    mask = np.ones(len(points) + 9, bool)
    mask[len(points) :] = False
    # A point in the middle of each cell, and the corners of the box.
    box = np.concatenate([points + 0.5, np.full((9, d), -7.0)]).astype(np.float32)
    box[np.all(box == 0.5, axis=1)] = 0
    box[np.all(box == side - 0.5, axis=1)] = side
    rows = np.asarray(jax.jit(hilbert_order)(jnp.asarray(box), jnp.asarray(mask)))
    np.testing.assert_array_equal(np.sort(rows), np.arange(len(box)))
    walked = points[rows[rows < len(points)]]
    np.testing.assert_array_equal(np.abs(np.diff(walked, axis=0)).sum(1), 1)
    assert np.all(rows[-8:] >= len(points))  # the last cell's own point among them
