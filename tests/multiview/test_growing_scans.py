"""Programs that know no number of scans."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from growing import SCANS, T_WORLD
from helpers import pose_error

import jaxreg as jr
from jaxreg.geometry import lie
from jaxreg.multiview import (
    likely_overlap,
    place,
    prepare_in_blocks,
    relative_motions,
    scan_blocks,
    which_join,
)
from jaxreg.multiview.hold_poses import Held
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.which_join import displacement, joins


def _solved(num: int, **told: Any) -> jr.ReconstructionSolution:
    return jr.reconstruct(
        SCANS[:num],
        key=jax.random.key(3),
        method=jr.ICP(),
        averaging=jr.SpanningTree(),
        **told,
    )


def _padded(num: int) -> tuple[jax.Array, jax.Array]:
    points = np.zeros((num, len(SCANS[0]), 3), np.float32)
    for row, scan in zip(points, SCANS, strict=False):
        row[: len(scan)] = scan
    return jnp.asarray(points), jnp.any(jnp.asarray(points) != 0, axis=-1)


def _prepared(num: int) -> PreparedScans:
    return prepare_in_blocks.prepare_in_blocks(jr.ICP(), *_padded(num))


def _watched(names: list[str], name: str, function: Callable, *args: object) -> object:
    names.append(name)
    return function(*args)


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is traced of the two programs that take longest to compile."""
    jax.clear_caches()
    names: list[str] = []
    for module, name in ((relative_motions, "solve"), (which_join, "confirmed_parts")):
        watched = partial(_watched, names, name, getattr(module, name))
        monkeypatch.setattr(module, name, watched)
    return names


def test_one_more_scan_takes_the_programs_that_are_there(traced):
    assert _solved(3).num_scans == 3
    assert set(traced) == {"solve", "confirmed_parts"}
    traced.clear()
    assert _solved(4).num_scans == 4
    assert not traced


def test_pairs_of_more_scans_take_the_program_of_those_of_few(traced):
    pairs, key = np.array([[0, 1], [1, 2]], np.int32), jax.random.key(0)
    for num, calls in ((3, 1), (7, 0)):
        traced.clear()
        motions = relative_motions.relative_motions(
            jr.ICP(), *_prepared(num).of_pairs(pairs), key
        )
        assert np.all(np.asarray(motions.overlap) > 0.5)
        assert traced == ["solve"] * calls


def test_padding_changes_no_answer(monkeypatch):
    padded = _solved(5)
    for module in (scan_blocks, prepare_in_blocks):
        monkeypatch.setattr(module, "rows_for", lambda num: num)
    exact = _solved(5)
    assert int(padded.status) == jr.Status.CONVERGED
    assert repr(padded) == repr(exact)
    for mine, other in zip(
        jax.tree.leaves(padded), jax.tree.leaves(exact), strict=True
    ):
        assert mine.shape == other.shape
        np.testing.assert_allclose(mine, other, atol=1e-4)
    np.testing.assert_allclose(padded.T_world_i, exact.T_world_i, atol=1e-5)


def test_padding_is_in_no_pair_of_new_scans(monkeypatch):
    monkeypatch.setattr(likely_overlap, "_ALL_UP_TO", 2)
    zero = jnp.zeros((), jnp.int32)
    placed = place.Placement(
        T_world_i=jnp.tile(jnp.eye(4), (6, 1, 1)),
        part=jnp.zeros(6, jnp.int32),
        edge_weight=jnp.zeros(1),
        mode=jnp.zeros(1, jnp.int32),
        status=zero,
        trace=None,
        world=zero - 1,
        misfit=jnp.zeros(6, bool),
    )
    held = np.array([True] * 4 + [False] * 2)
    near = likely_overlap.LikelyOverlap(_prepared(5), held).of(placed)
    assert len(near.pairs)
    np.testing.assert_array_equal(near.pairs[:, 1], 4)


def test_new_scans_lie_beside_those_that_are_held():
    before = _solved(4)
    after = _solved(5, previous=before, hold_previous=True)
    assert int(after.status) == jr.Status.CONVERGED
    assert after.num_scans == 5
    np.testing.assert_array_equal(after.T_world_i[:4], before.T_world_i)
    T = np.linalg.inv(T_WORLD[0]) @ T_WORLD[4]
    assert pose_error(after.T_world_i[4], T)[0] < 0.02
    # All poses rest on pairs, those that are held on those that they rested on.
    weights = [
        {
            (i, j): w
            for (i, j), w in zip(x.pairs.tolist(), x.weight.tolist(), strict=True)
        }
        for x in (before.averaged, after.averaged)
    ]
    held = {(i, j): w for (i, j), w in weights[0].items() if i != j}
    assert held.items() <= weights[1].items()
    assert any(w > 0 and 4 in pair for pair, w in weights[1].items())
    assert np.isfinite(jr.scan_covariances(SCANS[:5], after)).all()


def test_in_a_round_pairs_of_two_that_stay_count_as_their_poses_have_them():
    every, scans = _solved(5), _prepared(5)
    found = every.motions.heard(scans).on_host()
    ids = found.pairs.tolist()
    T = found.T_i_j.copy()
    T[ids.index([0, 1])] = T[ids.index([0, 2])]  # of two that stay: wrong
    found = eqx.tree_at(lambda m: m.T_i_j, found, T)
    hold = Held.of(_solved(4), scans)
    told = found.padded(16), jr.SpanningTree(), jnp.zeros(())
    placed = hold.place(scans, *told)
    trusted = np.asarray(joins(placed.edge_weight))
    assert not np.any(trusted[len(ids) :])
    told = dict(zip(map(tuple, ids), trusted.tolist(), strict=False))
    assert not told[0, 1]
    assert told[0, 2]
    assert told[1, 2]
    assert any(told[k, 4] for k in range(4))
    np.testing.assert_array_equal(placed.part[:5], np.zeros(5))
    apart, _ = displacement(
        lie.between(placed.T_world_i[0], placed.T_world_i[4]),
        jnp.asarray(found.T_i_j[ids.index([0, 4]), 0]),
    )
    assert apart < 0.02


def test_new_scans_that_join_each_other_alone_are_a_part_of_their_own():
    scans = _prepared(9)
    hold = Held.of(_solved(3), scans)
    pairs = np.array([[0, 1], [0, 2], [1, 2], [3, 4], [4, 5], [5, 6]], np.int32)
    found = relative_motions.relative_motions(
        jr.ICP(), scans, jnp.asarray(pairs), jax.random.key(0)
    )
    told = found.padded(8), jr.SpanningTree(), jnp.zeros(())
    placed = hold.place(scans, *told)
    # Those that stay come first, though the others are more.
    component = [0, 0, 0, 1, 1, 1, 1]
    np.testing.assert_array_equal(placed.component[:7], component)
    # The last have no points, or are padding.
    assert len(placed.component) == 12
    assert np.all(np.asarray(placed.component[7:]) == -1)
    T_5_6 = lie.between(placed.T_world_i[5], placed.T_world_i[6])
    np.testing.assert_allclose(T_5_6, found.T_i_j[5, 0], atol=1e-5)


def test_padding_is_the_last_scan_again_and_cannot_be_registered():
    scans = _prepared(5)
    assert (scans.num_scans, scans.num_present) == (6, 5)
    np.testing.assert_array_equal(scans.present, [True] * 5 + [False])
    np.testing.assert_array_equal(scans.usable, scans.present)
    # It counts for nothing in what is common to all.
    size = [np.sqrt(np.sum(np.var(x, axis=0))) for x in SCANS[:5]]
    np.testing.assert_allclose(scans.radius, np.median(size), rtol=1e-5)
    for x in jax.tree.leaves((scans.clouds, scans.exact, scans.mean, scans.spacing)):
        assert len(x) == 6
        np.testing.assert_array_equal(x[5], x[4])


def test_scans_are_prepared_alike_in_any_block():
    few, many = _prepared(2), _prepared(7)
    # Their unit is the median radius of all.
    unit = float(few.radius / many.radius)
    for mine, other in ((few.mean, many.mean), (unit * few.spacing, many.spacing)):
        np.testing.assert_allclose(mine[:2], other[:2], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        unit * few.clouds.points[:2], many.clouds.points[:2], atol=1e-5
    )


def test_scans_stay_on_the_device_that_they_were_put_on():
    points, mask = jax.device_put(_padded(3), jax.devices()[1])
    scans = prepare_in_blocks.prepare_in_blocks(jr.ICP(), points, mask)
    assert scans.clouds.points.devices() == points.devices()
    some, _ = scans.of_pairs(np.array([[0, 1]], np.int32))
    assert some.clouds.points.devices() == points.devices()


def test_a_pair_has_its_own_random_numbers_among_any_scans():
    scans, key = _prepared(4), jax.random.key(5)
    method = jr.MultiStart(num_starts=16, num_steps=4, num_modes=1, batch_size=16)
    pairs = np.array([[1, 3], [0, 2]], np.int32)
    found = [
        relative_motions.relative_motions(method, *scans.of_pairs(some), key)
        for some in (pairs, pairs[::-1])
    ]
    whole = relative_motions.relative_motions(method, scans, jnp.asarray(pairs), key)
    np.testing.assert_array_equal(found[0].pairs, pairs)
    told = map(jax.tree.leaves, (*found, whole))
    for mine, turned, all_scans in zip(*told, strict=True):
        np.testing.assert_array_equal(mine, turned[::-1])
        np.testing.assert_allclose(mine, all_scans, atol=1e-5)
