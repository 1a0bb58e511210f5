"""What is made of scans once, before any pair."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg.features import features_of
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.prepared_scans import PreparedScans


NUM = 400


def surface(seed: int) -> np.ndarray:
    """A bumpy ribbon: so narrow that the nearest points are not all around."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, (2, NUM))
    y = 0.01 * y
    z = 0.1 * np.sin(9 * x + seed)
    return np.stack([x, y, z], axis=1)


def prepared(kept: list[int], *, to_search: bool = True) -> PreparedScans:
    """Of ribbons of which so many points are left."""
    points = jnp.asarray(np.stack([surface(k) for k in range(len(kept))]), jnp.float32)
    mask = jnp.arange(NUM) < jnp.asarray(kept)[:, None]
    return prepare_scans(jr.ParticleFilter(), points, mask, to_search=to_search)


@pytest.mark.parametrize("few", [NUM // 2, 12])
def test_features_are_as_wide_as_the_coarser_scans_need(few):
    scans = prepared([NUM, NUM, few])
    spacing = np.asarray(scans.spacing)
    wanted = min(spacing[2], 2 * np.median(spacing))
    assert (wanted < spacing[2]) == (few == 12)
    assert wanted > 1.2 * spacing[0]
    cloud = scans.cloud(jnp.asarray(0))
    expected = jax.jit(features_of)(cloud, jnp.asarray(wanted))
    assert cloud.described is not None
    np.testing.assert_allclose(cloud.described.even, expected.even, atol=1e-5)
    np.testing.assert_allclose(cloud.described.odd, expected.odd, atol=1e-5)
    wider = jax.jit(features_of)(cloud, jnp.asarray(1.2 * wanted))
    assert float(jnp.max(jnp.abs(wider.even - expected.even))) > 1e-3


def test_only_what_is_to_be_searched_for_has_features():
    assert prepared([NUM, NUM], to_search=False).clouds.described is None
