"""Pairs that may overlap, of few scans and of many."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import ParticleFilter
from jaxreg.multiview import likely_overlap
from jaxreg.multiview.likely_overlap import LikelyOverlap
from jaxreg.multiview.near_pairs import near_pairs
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions


NUM, LENGTH, STEP = 24, 6, 1.0


@pytest.fixture(scope="module")
def street() -> tuple[PreparedScans, Placement]:
    """Scans of a wavy strip, each a step further, three wide to either side."""
    scans = _prepared()
    T = np.tile(np.eye(4, dtype=np.float32), (NUM, 1, 1))
    T[:, 0, 3] = STEP * np.arange(NUM)
    T[:, :3, 3] = (T[:, :3, 3] + np.asarray(scans.mean)) / float(scans.radius)
    return scans, _placed(T)


def _prepared() -> PreparedScans:
    rng = np.random.default_rng(0)
    local = rng.uniform(-0.5, 0.5, (NUM, 200, 2)) * [LENGTH, 2]
    x = local[..., 0] + STEP * np.arange(NUM)[:, None]
    z = 0.3 * np.sin(x) + 0.2 * np.cos(2 * local[..., 1])
    points = np.concatenate([local, z[..., None]], axis=-1).astype(np.float32)
    mask = jnp.ones(points.shape[:2], bool)
    return prepare_scans(ParticleFilter(), jnp.asarray(points), mask)


def _placed(T_world_i: np.ndarray, part: np.ndarray | None = None) -> Placement:
    part = np.zeros(len(T_world_i), np.int32) if part is None else part
    zero = jnp.zeros((), jnp.int32)
    return Placement(
        T_world_i=jnp.asarray(T_world_i),
        part=jnp.asarray(part),
        edge_weight=jnp.zeros(1),
        mode=jnp.zeros(1, jnp.int32),
        status=zero,
        trace=None,
        world=zero - 1,
        misfit=jnp.zeros(len(part), bool),
    )


def _told(near: likely_overlap.NearPairs) -> dict[tuple[int, int], float]:
    ids = map(tuple, np.asarray(near.pairs).tolist())
    return dict(zip(ids, np.asarray(near.overlap).tolist(), strict=True))


def test_the_share_falls_with_the_distance(street):
    told = _told(LikelyOverlap(street[0]).of(street[1]))
    drift = 6 * float(street[0].coarsest * street[0].radius)
    for (i, j), share in told.items():
        least = 1 - (j - i) * STEP / LENGTH
        assert max(least, 0) - 0.1 <= share <= max(least + drift / LENGTH, 0) + 0.1


def test_scans_of_two_parts_are_no_pair(street):
    scans, placed = street
    part = np.where(np.arange(NUM) < NUM // 2, 0, NUM // 2).astype(np.int32)
    told = _told(LikelyOverlap(scans).of(_placed(np.asarray(placed.T_world_i), part)))
    assert all(part[i] == part[j] for i, j in told)


def test_of_many_scans_those_that_share_space_are_found(street, monkeypatch):
    scans, placed = street
    every = _told(LikelyOverlap(scans).of(placed))
    monkeypatch.setattr(likely_overlap, "_ALL_UP_TO", NUM - 1)
    drawn = _told(LikelyOverlap(scans).of(placed))
    assert len(drawn) < 0.8 * len(every)
    for pair, share in every.items():
        if share >= 0.7:
            assert drawn[pair] == share


def test_only_what_moved_is_looked_at_again(street, monkeypatch):
    scans, placed = street
    overlaps = LikelyOverlap(scans)
    before = _told(overlaps.of(placed))
    seen: list[np.ndarray] = []
    look = likely_overlap.likely_overlap

    def watched(scans, placement, pairs):
        seen.append(np.asarray(pairs))
        return look(scans, placement, pairs)

    monkeypatch.setattr(likely_overlap, "likely_overlap", watched)
    assert _told(overlaps.of(placed)) == before
    T = np.array(placed.T_world_i)
    T[7, 0, 3] += 1.0
    after = _told(overlaps.of(_placed(T)))
    assert len(seen[0]) == 0
    assert len(seen[1]) == NUM - 1
    assert np.all(np.any(seen[1] == 7, axis=1))
    assert after[7, 8] != before[7, 8]


def test_of_very_many_scans_tables_are_made_when_needed(street, monkeypatch):
    scans, placed = street
    jax.clear_caches()
    monkeypatch.setattr("jaxreg.multiview.prepare._MOST_TABLES", NUM - 1)
    without = _prepared()
    assert without.tables is None
    one = jnp.asarray(3)
    tables = (x.table(ParticleFilter(), one) for x in (scans, without))
    for held, made in zip(*map(jax.tree.leaves, tables), strict=True):
        np.testing.assert_array_equal(held, made)
    told, exact = (_told(LikelyOverlap(x).of(placed)) for x in (scans, without))
    jax.clear_caches()
    for pair, share in told.items():
        assert exact[pair] == pytest.approx(share, abs=0.05)


def test_partners_are_limited_and_padding_comes_last(street, monkeypatch):
    scans, placed = street
    eye = jnp.eye(4)[None, None]
    none = jnp.zeros((1, 1))
    tried = RelativeMotions(jnp.array([[0, 20]], jnp.int32), eye, none, none, none)
    trusted = Placement(**{**vars(placed), "edge_weight": jnp.ones(1)})
    monkeypatch.setattr("jaxreg.multiview.near_pairs._PARTNERS", 3)
    pairs = np.asarray(near_pairs(scans, trusted, tried, LikelyOverlap(scans)))
    traced = jax.jit(lambda p: near_pairs(scans, p, tried))(trusted)
    np.testing.assert_array_equal(traced, pairs)
    real = pairs[:, 0] < pairs[:, 1]
    assert np.all(real[: real.sum()])
    assert np.all(pairs[~real, 0] == pairs[~real, 1])
    told = pairs[real].tolist()
    assert len(np.unique(told, axis=0)) == len(told)
    assert [0, 20] in told  # it placed them
    every = _told(LikelyOverlap(scans).of(placed))
    assert all(every[i, j] >= 0.2 for i, j in told if (i, j) != (0, 20))
    of_each = np.bincount(np.ravel(told), minlength=NUM)
    assert of_each.min() >= 2
    assert len(told) <= 3 * NUM
