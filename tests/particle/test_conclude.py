"""Weights of modes, and when one of them rivals the first."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.matching import NO_EVIDENCE
from jaxreg.particle.conclude import _has_rival, _weights


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
    ("log_evidence", "rival"),
    [((5.0, 3.9), False), ((5.0, 4.1), True), ((5.0, NO_EVIDENCE), False)],
)
def test_a_mode_is_a_rival_if_it_is_nearly_as_likely(log_evidence, rival):
    assert bool(_has_rival(jnp.asarray(log_evidence, jnp.float32))) == rival
