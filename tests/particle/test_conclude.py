"""Weights of modes, and when one of them rivals the first."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jaxreg.cloud import PointCloud
from jaxreg.neighbours import BruteForce
from jaxreg.particle.conclude import Pair, _has_rival, _weights


def _pair(num_source: int, num_target: int) -> Pair:
    points = jnp.zeros((400, 3))
    source, target = (
        PointCloud(points, points, jnp.arange(400) < num)
        for num in (num_source, num_target)
    )
    indexes = (BruteForce.build(x.points, x.mask) for x in (source, target))
    return Pair(source, target, *indexes)


@pytest.mark.parametrize("sizes", [(300, 200), (200, 400)])
def test_modes_weigh_as_their_overlaps_are_likely_to_differ_by_chance(sizes):
    overlap = np.array([0.6, 0.58, 0.5, -1.0])
    found = _weights(jnp.asarray(overlap, jnp.float32), _pair(*sizes))
    # Shares of 200 points each, which are 0.6 in truth.
    error = np.sqrt(2 * 0.6 * 0.4 / 200)
    density = norm.pdf(overlap, loc=0.6, scale=error) * (overlap >= 0)
    np.testing.assert_allclose(found, density / density.sum(), rtol=1e-4)


def test_modes_in_use_keep_some_weight_and_the_others_none():
    found = _weights(jnp.asarray([0.9, 0.0, -1.0], jnp.float32), _pair(400, 400))
    assert float(found[0]) == 1
    assert float(found[1]) > 0
    assert float(found[2]) == 0
    np.testing.assert_array_equal(_weights(jnp.full(3, -1.0), _pair(9, 9)), 0)


@pytest.mark.parametrize(
    ("overlap", "weight", "rival"),
    [
        ((0.6, 0.4), (0.9, 0.05), False),
        ((0.6, 0.58), (0.9, 0.05), True),  # nearly as large
        ((0.6, 0.4), (0.8, 0.2), True),  # as likely by chance
        ((0.6, -1), (1.0, 0.0), False),
    ],
)
def test_a_mode_is_a_rival_by_overlap_or_by_weight(overlap, weight, rival):
    found = _has_rival(*(jnp.asarray(x, jnp.float32) for x in (overlap, weight)))
    assert bool(found) == rival
