"""Which scans look alike."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxreg import ParticleFilter
from jaxreg.datasets import sculpture_scans
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.similar_scans import most_alike, words_of


NUM = 24


@pytest.fixture(scope="module")
def views() -> tuple[PreparedScans, np.ndarray]:
    """Prepared views, and their points in the world."""
    scans, T_world_i = sculpture_scans(NUM, seed=0, points_per_scan=2000)
    points = jnp.asarray(np.stack([scan[:1500] for scan in scans]), jnp.float32)
    mask = jnp.ones(points.shape[:2], bool)
    method = ParticleFilter(num_points=1024)
    prepared = prepare_scans(method, points, mask, to_search=True)
    R, t = T_world_i[:, None, :3, :3], T_world_i[:, None, :3, 3]
    return prepared, (R @ np.asarray(points)[..., None])[..., 0] + t


def _shared(world: np.ndarray, i: int, j: int) -> float:
    """How much of scan j is near scan i."""
    return float(np.mean(KDTree(world[i]).query(world[j])[0] < 0.01))


def _with_mask(scans: PreparedScans, mask: jax.Array) -> PreparedScans:
    """Whose features are known where the mask says."""
    return eqx.tree_at(lambda s: s.clouds.described.mask, scans, mask)


def test_scans_that_look_alike_share_surfaces(views):
    scans, world = views
    words = words_of(scans)
    assert words is not None
    near = most_alike(words.used, 2)
    assert near.shape == (NUM, 2)
    ids = range(NUM)
    chosen = [_shared(world, i, j) for i in ids for j in near[i].tolist()]
    every = [_shared(world, i, j) for i in ids for j in ids if i != j]
    assert np.median(chosen) > np.quantile(every, 0.75)
    assert np.min(chosen) > 0.5 * np.median(every)


def test_the_most_alike_use_the_same_words_as_often(views):
    scans, _ = views
    words = words_of(scans)
    assert words is not None
    used = words.used
    np.testing.assert_allclose(np.linalg.norm(used, axis=1), 1)
    near = most_alike(used, 1)[:, 0]
    np.testing.assert_array_equal(np.argsort(-used @ used.T)[:, 1], near)


def test_a_scan_without_features_is_like_no_other(views):
    scans, _ = views
    described = scans.clouds.described
    assert described is not None
    words = words_of(_with_mask(scans, described.mask.at[3].set(False)))
    assert words is not None
    assert not np.any(words.used[3])
    others = np.delete(words.used, 3, axis=0)
    assert np.all(np.linalg.norm(others, axis=1) > 0.99)


def test_scans_that_come_later_are_told_by_the_words_that_there_are(views):
    scans, _ = views
    first = words_of(eqx.tree_at(lambda s: s.count, scans, jnp.asarray(20, jnp.int32)))
    assert first is not None
    every = words_of(scans, first)
    assert every is not None
    assert every.vocabulary is first.vocabulary
    assert every.used.shape == (NUM, len(first.vocabulary))
    np.testing.assert_array_equal(every.used[:20], first.used)
    described = scans.clouds.described
    assert described is not None
    features = np.asarray(described.even[23])[np.asarray(described.mask[23])]
    _, nearest = KDTree(first.vocabulary).query(features)
    counts = np.bincount(nearest, minlength=len(first.vocabulary))
    np.testing.assert_allclose(every.used[23] ** 2, counts / counts.sum(), atol=1e-12)


@pytest.mark.parametrize("held", [True, False])
def test_scans_none_of_which_has_features_have_no_words(views, held):
    scans, _ = views
    described = scans.clouds.described
    assert described is not None
    blank = _with_mask(scans, jnp.zeros_like(described.mask))
    if not held:
        blank = eqx.tree_at(lambda s: s.clouds.described, scans, None)
    assert words_of(blank) is None


def test_of_equal_scans_each_has_others():
    near = most_alike(np.ones((7, 4)) / 2, 3)
    assert near.shape == (7, 3)
    assert not np.any(near == np.arange(7)[:, None])
    assert all(len(set(row)) == 3 for row in near.tolist())
