"""From relative motions to poses."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, pose_error

from jaxreg import MCC, SpanningTree
from jaxreg.multiview import RelativeMotions
from jaxreg.multiview.choose_pairs import all_pairs
from jaxreg.multiview.place import Placement, place
from jaxreg.multiview.which_join import roughly, strictly


T_TRUE = np.stack([motion(k, 3) for k in range(7)]).astype(np.float32)
PAIRS = all_pairs(7)
# A search took a wrong mode for the best of these pairs; of SECOND the right one is the
# second, of LOST it was not found.
SECOND, LOST = (2, 6, 9, 14), (4, 17)
# Beside what a test tells of so many scans others lie alone: all are of one program.
NUM = 10
LEAST = jnp.float32(1.0)


def _placed(motions: RelativeMotions) -> Placement:
    return place(motions.with_modes(4).padded(NUM * (NUM - 1) // 2), NUM, None, LEAST)


def _alone(first: int) -> list[int]:
    """Parts of scans from here on that nothing is told of."""
    return list(range(first, NUM))


def _motions(order: list[int]) -> RelativeMotions:
    i, j = PAIRS.T
    right = np.linalg.inv(T_TRUE[i]) @ T_TRUE[j]
    wrong = [[motion(100 + 5 * e + k, 3) for k in range(3)] for e in range(len(PAIRS))]
    modes = np.concatenate([right[:, None], np.array(wrong, np.float32)], axis=1)
    overlap = np.tile(np.array([0.4, 0.2, 0.15, 0], np.float32), (len(PAIRS), 1))
    for e in SECOND:
        modes[e, :2] = modes[e, 1::-1]
    modes[list(LOST), 0] = modes[list(LOST), 3]
    overlap[list(SECOND + LOST), 0] = 0.25
    log_evidence = np.where(overlap > 0, 20 * overlap - 2, -100).astype(np.float32)
    arrays = PAIRS, modes, overlap, log_evidence, 0.01 * overlap
    return RelativeMotions(*(jnp.asarray(x[order]) for x in arrays))


def test_a_second_mode_counts_where_it_agrees_with_the_poses():
    every = list(range(len(PAIRS)))
    for order in (every, every[::-1]):
        found = _placed(_motions(order))
        for T, T_true in zip(found.T_world_i[:7], T_TRUE, strict=True):
            T_expected = np.linalg.inv(T_TRUE[0]) @ T_true
            angle, shift = pose_error(T, T_expected)
            assert angle < 1e-3
            assert shift < 1e-3
        mode, weight = (np.asarray(x)[order] for x in (found.mode, found.edge_weight))
        np.testing.assert_array_equal(mode, np.isin(every, SECOND))
        np.testing.assert_array_equal(weight < 0.1, np.isin(every, LOST))
        np.testing.assert_array_equal(found.part, [0] * 7 + _alone(7))


def test_without_second_modes_their_pairs_are_not_believed():
    motions = _motions(list(range(len(PAIRS)))).with_modes(1)
    weight = np.asarray(_placed(motions).edge_weight)[: len(PAIRS)]
    wrong = np.isin(range(len(PAIRS)), SECOND + LOST)
    np.testing.assert_array_equal(weight < 0.1, wrong)


def test_the_only_pair_of_two_scans_needs_no_other_to_confirm_it():
    T_i_j = (np.linalg.inv(T_TRUE[0]) @ T_TRUE[1])[None, None]
    weak, told = np.full((1, 1), 0.15, np.float32), np.full((1, 1), 1.5, np.float32)
    ids = np.array([[0, 1]], np.int32)
    pair = RelativeMotions(*map(jnp.asarray, (ids, T_i_j, weak, told, weak))).padded(3)
    for num_scans, parts in ((2, [0, 0, 2]), (3, [0, 1, 2])):
        found = place(pair, 3, None, LEAST, jnp.asarray(num_scans))
        np.testing.assert_array_equal(found.part, parts)


@pytest.mark.parametrize("num_loops", [0, 1])
def test_loops_join_scans_none_of_whose_pairs_would_be_believed(num_loops):
    ids = np.array([[0, 1], [1, 2], [0, 2]][: 2 + num_loops], np.int32)
    i, j = ids.T
    T_i_j = (np.linalg.inv(T_TRUE[i]) @ T_TRUE[j])[:, None].astype(np.float32)
    told = np.full((len(ids), 1), 0.5, np.float32)
    share = np.full((len(ids), 1), 0.3, np.float32)
    arrays = ids, T_i_j, share, told, share
    motions = RelativeMotions(*map(jnp.asarray, arrays)).padded(3)
    found = place(motions, 3, None, LEAST)
    np.testing.assert_array_equal(found.part, [0, 0, 0] if num_loops else [0, 1, 2])


def _told(ids: list[tuple[int, int]], told: list[list[float]]) -> RelativeMotions:
    """Pairs whose first mode is right, the second is of another pose."""
    i, j = np.array(ids).T
    right = np.linalg.inv(T_TRUE[i]) @ T_TRUE[j]
    wrong = np.stack([motion(50 + k, 3) for k in range(len(ids))])
    modes = np.stack([right, wrong], axis=1).astype(np.float32)
    share = np.full((len(ids), 2), 0.4, np.float32)
    arrays = np.array(ids, np.int32), modes, share, np.array(told, np.float32), share
    return RelativeMotions(*map(jnp.asarray, arrays))


def test_log_odds_count_rivals_and_that_none_is_right():
    motions = _told([(0, 1), (1, 2), (2, 3)], [[4, -100], [4, 4], [4, 2.5]])
    odds = np.asarray(motions.log_odds)
    np.testing.assert_allclose(odds[0], [4, -100 - np.log1p(np.exp(4))], rtol=1e-5)
    np.testing.assert_allclose(odds[1], -np.log1p(np.exp(-4)), rtol=1e-4)
    np.testing.assert_allclose(odds[2, 0], 4 - np.log1p(np.exp(2.5)), rtol=1e-4)
    alone = jnp.array([True, True, False])
    one = motions.of_modes(jnp.zeros(3, jnp.int32), alone)
    np.testing.assert_allclose(one.log_evidence[:, 0], [4, 4, odds[2, 0]], rtol=1e-5)


def test_an_answer_with_a_rival_joins_no_scans_unless_others_confirm_it():
    clear, rivalled = [5.0, -100.0], [5.0, 4.8]
    ids = [(0, 1), (1, 2), (2, 3), (3, 4)]
    told = [clear, clear, clear, rivalled]
    found = _placed(_told(ids, told))
    np.testing.assert_array_equal(found.part, [0] * 4 + _alone(4))
    found = _placed(_told([*ids, (2, 4)], [*told, rivalled]))
    np.testing.assert_array_equal(found.part, [0] * 5 + _alone(5))
    np.testing.assert_array_equal(found.mode, 0)


def test_of_something_symmetric_one_mode_is_as_good_as_another():
    ids = [(0, 1), (1, 2), (2, 3)]
    found = _placed(_told(ids, [[5.0, 4.9]] * 3))
    np.testing.assert_array_equal(found.part, [0] * 4 + _alone(4))


def test_a_wrong_pair_that_shares_much_does_not_keep_likelier_ones_out():
    """Two parts of five scans; between them small shares are right, a large one not."""
    T = np.stack([motion(200 + k, 3) for k in range(10)])
    within = [(i, j) for i, j in all_pairs(10).tolist() if (i < 5) == (j < 5)]
    across = [(0, 5), (1, 7), (3, 9), (2, 6)]
    i, j = np.array(within + across).T
    modes = (np.linalg.inv(T[i]) @ T[j])[:, None].astype(np.float32)
    modes[-1] = motion(300, 3)
    share = np.r_[np.full(len(within), 0.6), [0.2] * 3, 0.95][:, None]
    told = np.r_[np.full(len(within), 6.0), [4.0] * 3, 1.1][:, None]
    floats = [x.astype(np.float32) for x in (share, told, share)]
    arrays = np.stack([i, j], 1).astype(np.int32), modes, *floats
    found = _placed(RelativeMotions(*map(jnp.asarray, arrays)))
    np.testing.assert_array_equal(found.part, 0)
    trusted = np.asarray(found.edge_weight)[: len(i)] > 0.5
    np.testing.assert_array_equal(trusted, np.arange(len(i)) < 23)


def test_poses_to_start_from_decide_where_a_tree_would_lead_astray():
    T = np.stack([motion(k, 3) for k in range(NUM)])
    ids = np.concatenate([all_pairs(6), [[0, 6], [1, 6], [2, 6], [7, 8]]])
    T_i_j = np.linalg.inv(T[ids[:, 0]]) @ T[ids[:, 1]]
    overlap, wrong = np.full(len(ids), 0.4), len(ids) - 4
    T_i_j[wrong], overlap[wrong] = motion(50, 3), 0.9  # which a tree takes first
    row = overlap[:, None].astype(np.float32)
    each = ids.astype(np.int32), T_i_j[:, None].astype(np.float32), row, 12 * row, row
    motions = RelativeMotions(*map(jnp.asarray, each))
    start = T.copy()
    start[7:9, :3, 3] += 1e3  # a part in a frame of its own
    method, start = MCC(initialiser=SpanningTree()), jnp.asarray(start, jnp.float32)
    found = place(motions, NUM, method, LEAST, None, start)
    np.testing.assert_array_equal(found.part, [0] * 7 + [7, 7, 9])
    trusted = np.asarray(found.edge_weight) > 0.1
    np.testing.assert_array_equal(trusted, np.arange(len(ids)) != wrong)
    T_found = np.asarray(found.T_world_i)
    for i, j in ids.tolist():
        T_true = np.linalg.inv(T[i]) @ T[j]
        angle, shift = pose_error(np.linalg.inv(T_found[i]) @ T_found[j], T_true)
        assert angle < 1e-3
        assert shift < 1e-3


def _scan_held_roughly() -> RelativeMotions:
    """Scan 5 by three pairs that err by a hundredth, others by a ten-thousandth."""
    ids = np.concatenate([all_pairs(5), [[0, 5], [1, 5], [2, 5]]])
    T_i_j = np.linalg.inv(T_TRUE[ids[:, 0]]) @ T_TRUE[ids[:, 1]]
    rough = np.arange(len(ids)) >= 10
    for k, T in enumerate(T_i_j):
        T[:3, 3] += np.random.default_rng(k).normal(size=3) * (
            1e-2 if rough[k] else 1e-4
        )
    told = np.where(rough, 2.0, 6.0)[:, None]
    share = np.full((len(ids), 1), 0.4)
    floats = (x.astype(np.float32) for x in (T_i_j[:, None], share, told, share))
    return RelativeMotions(*map(jnp.asarray, (ids.astype(np.int32), *floats)))


def test_pairs_that_err_more_than_others_join_a_scan_where_they_agree():
    motions = _scan_held_roughly().padded(NUM * (NUM - 1) // 2)
    for within, last in ((strictly(LEAST), 5), (roughly(LEAST), 0)):
        found = place(motions, NUM, None, LEAST, None, None, within)
        np.testing.assert_array_equal(found.part, [0] * 5 + [last] + _alone(6))


def test_what_speaks_against_a_part_keeps_it_apart():
    """Both pairs of scan 3 agree; one with scan 2, which must meet it, does not."""
    ids = np.array([[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [2, 3]], np.int32)
    T_i_j = (np.linalg.inv(T_TRUE[ids[:, 0]]) @ T_TRUE[ids[:, 1]])[:, None]
    told = np.array([5, 5, 5, 1.5, 1.5, -9], np.float32)
    share = np.full((6, 1), 0.4, np.float32)
    each = ids, T_i_j.astype(np.float32), share, told[:, None], share
    motions = RelativeMotions(*map(jnp.asarray, each)).padded(NUM * (NUM - 1) // 2)
    odds = np.zeros(NUM * (NUM - 1) // 2, np.float32)
    for against, last in ((-0.5, 0), (-9.0, 3)):
        odds[:6] = [4, 4, 4, 0.5, 0.5, against]
        method, within = MCC(initialiser=SpanningTree()), roughly(LEAST)
        told = method, LEAST, None, None, within, jnp.asarray(odds)
        found = place(motions, NUM, *told)
        np.testing.assert_array_equal(found.part, [0, 0, 0, last] + _alone(4))
