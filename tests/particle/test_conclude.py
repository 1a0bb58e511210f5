"""Weights of modes, and when one of them rivals the first."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.matching import NO_EVIDENCE, Evidence
from jaxreg.matching.slippage import Grip
from jaxreg.particle.conclude import (
    LEAST_ODDS,
    _convincing,
    _Judged,
    _log_odds,
    _weights,
)


def _weighed(*log_evidence: float) -> np.ndarray:
    found = jnp.asarray(log_evidence, jnp.float32)
    return np.asarray(_weights(found, found > NO_EVIDENCE))


def test_modes_weigh_as_likely_as_they_are():
    expected = np.exp([3.0, 2.0, -1.0])
    np.testing.assert_allclose(
        _weighed(3.0, 2.0, -1.0, NO_EVIDENCE),
        [*(expected / expected.sum()), 0],
        rtol=1e-5,
    )


def test_modes_in_use_keep_some_weight_and_the_others_none():
    found = _weighed(60.0, -60.0, NO_EVIDENCE)
    assert found[0] == 1
    assert found[1] > 0
    assert found[2] == 0
    np.testing.assert_array_equal(_weighed(NO_EVIDENCE, NO_EVIDENCE), 0)


@pytest.mark.parametrize(
    ("log_evidence", "stands_out"),
    [
        ((5.0, 3.9), True),
        ((5.0, 4.1), False),
        ((5.0, NO_EVIDENCE), True),
        ((5.0,), True),
        # Two that fit worse are together a rival.
        ((5.0, 3.5, NO_EVIDENCE), True),
        ((5.0, 3.5, 3.5), False),
    ],
)
def test_modes_count_together_against_the_first(log_evidence, stands_out):
    found = _log_odds(jnp.asarray(log_evidence, jnp.float32))
    assert bool(found >= LEAST_ODDS) == stands_out


@pytest.mark.parametrize(
    ("overlap", "held", "counts"),
    [(0.2, True, True), (0.1, True, False), (0.2, False, False)],
)
def test_proposals_count_if_they_share_enough_and_hold(overlap, held, counts):
    # Planes of all directions about the origin, or of one.
    H = np.eye(6) if held else np.diag([1.0, 0, 0, 0, 0, 0])
    grip = Grip(*(jnp.asarray(x, jnp.float32) for x in (H, np.zeros(3), 1.0)))
    found = _convincing(jnp.asarray([overlap]), grip.holds[None])
    np.testing.assert_array_equal(found, [counts])


@pytest.mark.parametrize(
    ("holds", "told"),
    [((False, True), (-3.0, -2.0)), ((False, False), (4.0, 1.0))],
)
def test_contact_is_what_is_told_where_surfaces_hold_no_pose(holds, told):
    zero = jnp.zeros(2, jnp.float32)
    log_evidence, contact = (
        jnp.asarray(x, jnp.float32) for x in ((-3.0, -2.0), (4.0, 1.0))
    )
    grip = Grip(jnp.zeros((2, 6, 6)), jnp.zeros((2, 3)), zero)
    evidence = Evidence(
        log_evidence, contact, zero, zero, zero, jnp.zeros(2, jnp.int32), grip
    )
    found = _Judged(
        jnp.tile(jnp.eye(4), (2, 1, 1)),
        zero,
        jnp.ones(2, bool),
        evidence,
        jnp.asarray(holds),
    )
    np.testing.assert_array_equal(found.log_evidence, np.float32(told))
