"""Motions that are kept on disk come back as the search had them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg.multiview import RelativeMotions
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.testing.problems import motion, surface


@pytest.mark.parametrize("unit", [0.07, 31.7])
def test_what_is_told_is_heard_to_the_last_bit(unit):
    rng = np.random.default_rng(0)
    num = 200
    T = np.stack([motion(3, 0.1 * k, 0.5, k) for k in range(2 * num)])
    T_i_j = jnp.asarray(T.reshape(num, 2, 4, 4), jnp.float32)
    told = [jnp.asarray(x, jnp.float32) for x in rng.standard_normal((3, num, 2))]
    i = rng.integers(0, 5, num)
    pairs = jnp.asarray(np.stack([i, i + 1], axis=1), jnp.int32)
    motions = RelativeMotions(pairs, T_i_j, *told)
    places = 100 * rng.standard_normal((6, 1, 3))
    points = unit * (places + np.stack([surface(48, 3, k) for k in range(6)]))
    points = jnp.asarray(points, jnp.float32)
    scans = prepare_scans(jr.ICP(), points, jnp.ones(points.shape[:2], bool))
    kept = motions.told(scans)
    assert kept.T_i_j.dtype == np.float64
    inside = motions.in_input_frames(scans)
    np.testing.assert_allclose(kept.T_i_j, inside.T_i_j, atol=1e-4 * max(unit, 1))
    heard = RelativeMotions.kept(*jax.tree.leaves(kept)).heard(scans)
    for mine, other in zip(
        jax.tree.leaves(heard), jax.tree.leaves(motions), strict=True
    ):
        assert mine.dtype == other.dtype
        np.testing.assert_array_equal(mine, other)
