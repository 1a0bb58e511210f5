"""Scans that are made ready once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from growing import SCANS, T_WORLD
from helpers import pose_error

import jaxreg as jr
from jaxreg.multiview import prepare, scan_set


METHOD, KEY = jr.ICP(), jax.random.key(3)
HELD: dict[str, Any] = {"hold_previous": True}
FAR = np.array([4e5, 5e6, 100])


def _solved(scans: Any, **told: Any) -> jr.ReconstructionSolution:
    if not isinstance(scans, jr.ScanSet):
        told = {"method": METHOD, **told}
    return jr.reconstruct(scans, key=KEY, averaging=jr.SpanningTree(), **told)


def _same(mine: Any, other: Any) -> None:
    assert jax.tree.structure(mine) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(mine), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def ready() -> jr.ScanSet:
    """Four scans."""
    return jr.ScanSet.of(SCANS[:4], method=METHOD)


@pytest.fixture(scope="module")
def before(ready: jr.ScanSet) -> jr.ReconstructionSolution:
    """Where they lie."""
    return _solved(ready)


def test_a_set_has_the_answer_of_its_scans(ready, before):
    assert repr(ready) == "ScanSet(4 scans in 3D, float32, for ICP)"
    _same(before, _solved(SCANS[:4]))
    _same(before, _solved(ready, method=jr.ICP()))  # its own is no contradiction


def test_covariances_are_those_of_a_set_for_a_search(ready, before):
    method = jr.MultiStart(num_starts=16, num_steps=4, num_modes=1, batch_size=16)
    searched = jr.ScanSet.of(SCANS[:4], method=method)
    found = jr.scan_covariances(searched, before)
    np.testing.assert_array_equal(found, jr.scan_covariances(SCANS[:4], before))
    with pytest.raises(ValueError, match="scans: wanted a ScanSet for a search"):
        jr.scan_covariances(ready, before)


def test_a_scan_that_joins_is_prepared_alone(ready, before, monkeypatch):
    made = []
    further = scan_set.prepare_further

    def watched(method, scans, points, *rest):
        made.append(len(points))
        return further(method, scans, points, *rest)

    monkeypatch.setattr(scan_set, "prepare_further", watched)
    more = ready.joined([SCANS[4]])
    assert (made, len(ready), len(more)) == ([1], 4, 5)
    after = _solved(more, previous=before, **HELD)
    np.testing.assert_array_equal(after.T_world_i[:4], before.T_world_i)
    truth = np.linalg.inv(T_WORLD[0]) @ T_WORLD[4]
    assert pose_error(after.T_world_i[4], truth)[0] < 0.02
    # As if all had been given at once, but for the unit, which stays that of the first.
    anew = _solved(SCANS[:5], previous=before, **HELD)
    np.testing.assert_allclose(after.T_world_i, anew.T_world_i, atol=1e-5)


def test_scans_that_join_keep_the_unit_and_what_was_ready(ready):
    more = ready.joined(SCANS[4:6]).joined([1000 * SCANS[6]])
    assert float(more.scans.radius) == float(ready.scans.radius)
    every = more.scans
    for mine, first in zip(
        jax.tree.leaves((every.clouds, every.exact, every.mean)),
        jax.tree.leaves((ready.scans.clouds, ready.scans.exact, ready.scans.mean)),
        strict=True,
    ):
        np.testing.assert_array_equal(mine[:4], first[:4])
    wrong = jr.Status.UNIT_DIFFERS
    np.testing.assert_array_equal(every.fault[:7], [0] * 6 + [wrong])
    np.testing.assert_array_equal(every.usable[:7], [True] * 6 + [False])
    assert (every.num_present, every.num_scans) == (7, 8)
    assert int(every.fault[7]) == jr.Status.TOO_FEW_POINTS


def test_of_a_scan_with_more_points_than_the_set_has_some_are_drawn(ready):
    many = np.concatenate([SCANS[4], SCANS[4] + 1e-3])
    more = ready.joined([many])
    assert more.scans.clouds.points.shape[1:] == ready.scans.clouds.points.shape[1:]
    assert int(np.sum(more.scans.clouds.mask[4])) == ready.num_rows


def test_padded_arrays_join_as_lists_do(ready):
    points = np.zeros((2, 300, 3), np.float32)
    points[0, 50 : 50 + len(SCANS[4])] = SCANS[4]
    mask = np.any(points != 0, axis=2)
    listed = ready.joined([SCANS[4], np.full((1, 3), np.nan, np.float32)])
    _same(ready.joined(points, mask=mask), listed)
    assert int(listed.scans.fault[5]) == jr.Status.TOO_FEW_POINTS


def test_a_set_stays_on_its_device():
    device = jax.devices()[1]
    scans = np.stack([x[:140] for x in SCANS[:3]])
    ready = jr.ScanSet.of(jax.device_put(scans, device), method=METHOD)
    more = ready.joined([SCANS[3]])
    for x in jax.tree.leaves((ready.scans.clouds, more.scans.clouds)):
        assert x.devices() == {device}


def test_scans_far_from_their_origins_join():
    far = [np.asarray(x, np.float64) + FAR for x in SCANS[:5]]
    ready = jr.ScanSet.of(far[:4], method=METHOD)
    first = _solved(ready)
    # The first one near its origin, as of a scanner that has no satellite fix.
    after = _solved(ready.joined([SCANS[4]]), previous=first, **HELD)
    T = np.asarray(after.T_world_i)
    assert T.dtype == np.float64
    np.testing.assert_array_equal(T[:4], first.T_world_i)
    truth = np.linalg.inv(T_WORLD[0]) @ T_WORLD[4]
    here = np.asarray(SCANS[4], np.float64)
    found = here @ T[4, :3, :3].T + T[4, :3, 3]
    there = here @ truth[:3, :3].T + truth[:3, 3] + FAR
    assert np.abs(found - there).max() < 0.05


def _sees(ready: jr.ScanSet) -> list[bool]:
    """Of which scans it is known what their scanner saw."""
    image = ready.scans.clouds.seen
    if image is None:
        return [False] * len(ready)
    known = np.max(np.asarray(image.nearest), axis=(1, 2)) > -np.inf
    return known[: len(ready)].tolist()


def test_viewpoints_may_be_those_of_some(ready):
    assert not any(_sees(ready))
    later = ready.joined([SCANS[4]], viewpoints=[np.array([0.0, 0.0, 5.0])])
    assert _sees(later) == [False] * 4 + [True]
    assert _sees(later.joined([SCANS[5]])) == [False] * 4 + [True, False]


def test_a_set_of_very_many_scans_holds_no_tables(ready, monkeypatch):
    monkeypatch.setattr(prepare, "_MOST_TABLES", 4)
    assert ready.scans.tables is not None
    many = ready.joined([SCANS[4]])
    assert many.scans.tables is None
    assert many.joined([SCANS[5]]).scans.tables is None
    assert _solved(many).num_scans == 5


def test_positions_go_with_a_set():
    method = jr.MultiStart(num_starts=16, num_steps=4, num_modes=1, batch_size=16)
    ready = jr.ScanSet.of(SCANS[:3], method=method)
    where = jr.ScanPositions(np.array([T[:3, 3] for T in T_WORLD[:3]]), 0.05)
    prepared, _ = ready.prepared(method, where, to_search=True)
    assert prepared.positions is not None
    np.testing.assert_array_equal(prepared.positions.position[:3], where.position)
    assert ready.scans.positions is None
    with pytest.raises(ValueError, match=r"positions: wanted shape \(3, 3\)"):
        jr.reconstruct(ready, key=KEY, positions=jr.ScanPositions(np.zeros((4, 3))))


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"mask": np.ones((4, 200), bool)}, "mask, viewpoints: a ScanSet has its own"),
        ({"viewpoints": [None] * 4}, "mask, viewpoints: a ScanSet has its own"),
        ({"method": jr.ICP(jr.PointToPoint())}, "method: a ScanSet is ready for its"),
        ({"previous": jr.PoseGraph}, "previous: wanted a ReconstructionSolution"),
    ],
)
def test_what_does_not_go_with_a_set_is_refused(ready, told, words):
    with pytest.raises((ValueError, TypeError), match=words):
        jr.reconstruct(ready, key=KEY, **told)


def test_a_set_is_for_calls_outside_of_jit(ready):
    words = "a ScanSet is for calls outside of jit only"
    with pytest.raises(ValueError, match=words):
        jax.jit(lambda s: jr.reconstruct(s, key=KEY).T_world_i)(ready)
    with pytest.raises(ValueError, match=words):
        jax.jit(lambda key: jr.reconstruct(ready, key=key).T_world_i)(KEY)
    with pytest.raises(ValueError, match=words):
        jax.jit(lambda x: jr.ScanSet.of(x).scans.mean)(jnp.ones((2, 9, 3)))


@pytest.mark.parametrize(
    ("scans", "words"),
    [
        ([], "scans: wanted one or more, found 0"),
        ([np.ones((9, 2))], "scans: of dimension 2, those of the set of 3"),
        (np.ones((9, 3)), r"found shape \(9, 3\)"),
    ],
)
def test_what_cannot_join_is_refused(ready, scans, words):
    with pytest.raises(ValueError, match=words):
        ready.joined(scans)
