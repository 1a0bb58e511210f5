"""Which scans look alike."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxreg import ICP, ParticleFilter, ScanSet
from jaxreg.datasets import sculpture_scans
from jaxreg.multiview import prepare, similar_scans
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.similar_scans import most_alike, words_of


NUM = 24
METHOD = ParticleFilter(num_points=1024)


@pytest.fixture(scope="module")
def views() -> tuple[PreparedScans, np.ndarray]:
    """Prepared views, and their points in the world."""
    scans, T_world_i = sculpture_scans(NUM, seed=0, points_per_scan=2000)
    points = jnp.asarray(np.stack([scan[:1500] for scan in scans]), jnp.float32)
    mask = jnp.ones(points.shape[:2], bool)
    prepared = prepare_scans(METHOD, points, mask, to_search=True)
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
    words = words_of(METHOD, scans)
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
    words = words_of(METHOD, scans)
    assert words is not None
    used = words.used
    np.testing.assert_allclose(np.linalg.norm(used, axis=1), 1)
    near = most_alike(used, 1)[:, 0]
    np.testing.assert_array_equal(np.argsort(-used @ used.T)[:, 1], near)


def test_a_scan_without_features_is_like_no_other(views):
    scans, _ = views
    described = scans.clouds.described
    assert described is not None
    words = words_of(METHOD, _with_mask(scans, described.mask.at[3].set(False)))
    assert words is not None
    assert not np.any(words.used[3])
    others = np.delete(words.used, 3, axis=0)
    assert np.all(np.linalg.norm(others, axis=1) > 0.99)


def test_scans_that_come_later_are_told_by_the_words_that_there_are(views):
    scans, _ = views
    some = eqx.tree_at(lambda s: s.count, scans, jnp.asarray(20, jnp.int32))
    first = words_of(METHOD, some)
    assert first is not None
    every = words_of(METHOD, scans, first)
    assert every is not None
    assert every.vocabulary is first.vocabulary
    assert every.used.shape == (NUM, len(first.vocabulary))
    np.testing.assert_array_equal(every.used[:20], first.used)
    described = scans.clouds.described
    assert described is not None
    features = np.asarray(described.even[23])[np.asarray(described.mask[23])]
    _, nearest = KDTree(first.vocabulary).query(features)
    counts = np.bincount(nearest, minlength=len(first.vocabulary))
    np.testing.assert_allclose(every.used[23] ** 2, counts / counts.sum(), rtol=1e-6)


def test_scans_none_of_which_has_features_have_no_words(views):
    scans, _ = views
    described = scans.clouds.described
    assert described is not None
    blank = _with_mask(scans, jnp.zeros_like(described.mask))
    assert words_of(METHOD, blank) is None


def test_scans_that_no_search_is_for_have_no_words(views):
    scans, _ = views
    assert words_of(ICP(), scans) is None
    followed = eqx.tree_at(lambda s: s.feature_spacing, scans, None)
    assert words_of(METHOD, followed) is None


def test_features_that_are_not_held_are_made_for_words(views):
    scans, _ = views
    held, some = words_of(METHOD, scans), slice(0, 20)
    bare = eqx.tree_at(lambda s: s.clouds.described, scans, None)
    made = words_of(METHOD, bare)
    assert held is not None
    assert made is not None
    np.testing.assert_allclose(made.vocabulary, held.vocabulary, atol=1e-4)
    # Roundings may turn a few features to other words.
    alike = np.sum(made.used * held.used, axis=1)
    assert np.all(alike > 0.99)
    further = words_of(METHOD, bare, made._replace(used=made.used[some]))
    assert further is not None
    np.testing.assert_array_equal(further.used, made.used)


def test_of_very_many_scans_no_features_are_held_but_words_are_told(monkeypatch):
    monkeypatch.setattr(prepare, "_MOST_TABLES", 3)
    scans, _ = sculpture_scans(5, seed=0, points_per_scan=400)
    scans = [scan[:200] for scan in scans]
    many = ScanSet.of(scans[:4])
    more = many.joined(scans[4:])
    for ready in (many, more):
        assert ready.scans.clouds.as_judged.described is None
        assert ready.words is not None
        assert len(ready.words.used) == len(ready)
        assert np.all(np.linalg.norm(ready.words.used, axis=1) > 0.99)


def test_of_equal_scans_each_has_others():
    near = most_alike(np.ones((7, 4)) / 2, 3)
    assert near.shape == (7, 3)
    assert not np.any(near == np.arange(7)[:, None])
    assert all(len(set(row)) == 3 for row in near.tolist())


def test_of_other_parts_the_most_alike_come_first():
    words = np.random.default_rng(0).random((9, 4))
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    part = np.array([0, 0, 0, 3, 3, 3, 6, 6, 6])
    near = most_alike(words, 9, part, np.array([1, 5]))
    for i, row in zip((1, 5), near.tolist(), strict=True):
        others = [j for j in range(9) if part[j] != part[i]]
        assert row[:6] == sorted(others, key=lambda j: -(words[i] @ words[j]))
        assert sorted(row) == list(range(9))


def test_blocks_of_scans_tell_the_same(monkeypatch):
    words = np.random.default_rng(0).random((9, 4))
    every = most_alike(words, 3)
    monkeypatch.setattr(similar_scans, "_BLOCK", 4)
    np.testing.assert_array_equal(most_alike(words, 3), every)
