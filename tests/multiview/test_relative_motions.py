"""Motions that are kept on disk come back as the search had them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import compiled

import jaxreg as jr
from jaxreg.matching import NO_EVIDENCE
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


def test_motions_are_padded_to_any_number_without_a_program():
    ones = jnp.ones((5, 2))
    T_i_j = jnp.broadcast_to(jnp.eye(3), (5, 2, 3, 3))
    motions = RelativeMotions(jnp.ones((5, 2), jnp.int32), T_i_j, ones, ones, ones)
    with compiled() as names:
        found = [motions.on_host(slice(num)).padded(num + 4) for num in (2, 5)]
    assert names == []
    for num, out in zip((2, 5), found, strict=True):
        assert out.pairs.shape == (num + 4, 2)
        np.testing.assert_array_equal(out.log_evidence[:num], 1)
        np.testing.assert_array_equal(out.log_evidence[num:], NO_EVIDENCE)
        assert not out.pairs[num:].any()
        assert not out.overlap[num:].any()
