"""Which pairs are registered."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxreg.multiview.choose_pairs import all_pairs, first_pairs, most_pairs, next_pairs


RNG = np.random.default_rng(0)


def test_all_pairs_of_few_scans_and_ten_a_scan_of_many():
    assert most_pairs(20) == 190
    assert most_pairs(100) == 1000
    np.testing.assert_array_equal(first_pairs(12, "any", RNG), all_pairs(12))


@pytest.mark.parametrize("order", ["any", "sequential"])
def test_the_first_pairs_join_all_scans(order):
    pairs = first_pairs(60, order, RNG)
    assert len(pairs) <= most_pairs(60)
    assert np.all(pairs[:, 0] < pairs[:, 1])
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    joined = coo_array((np.ones(len(pairs)), pairs.T), (60, 60))
    assert connected_components(joined, directed=False)[0] == 1
    if order == "sequential":
        assert np.all(pairs[:, 1] - pairs[:, 0] <= 2)


NONE = np.zeros((0, 2), int), np.zeros(0)


def test_parts_are_joined_by_pairs_that_were_not_tried():
    tried = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]])
    trusted = np.array([True, True, True, False, True])
    part = np.array([0, 0, 0, 0, 4, 4])
    pairs = next_pairs(tried, trusted, *NONE, part, RNG)
    assert len(pairs) >= 2
    assert np.all((pairs[:, 0] < 4) & (pairs[:, 1] >= 4))
    assert [3, 4] not in pairs.tolist()


def test_a_scan_that_hangs_by_a_thread_gets_the_pair_that_overlaps_most():
    tried = np.concatenate([all_pairs(5), [[0, 5]]])
    trusted, part = np.ones(len(tried), bool), np.zeros(6, int)
    near = np.array([[1, 5], [2, 5], [3, 5], [4, 5], [0, 5]])
    overlap = np.array([0.3, 0.6, 0.1, 0.4, 0.9])  # the last was tried
    pairs = next_pairs(tried, trusted, near, overlap, part, RNG)
    assert pairs.tolist() == [[2, 5]]
    overlap[:2] = 0.19  # unlikely
    pairs = next_pairs(tried, trusted, near, overlap, part, RNG)
    assert pairs.tolist() == [[4, 5]]


def test_a_loop_is_closed_where_the_poses_say_that_scans_overlap():
    chain = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    tried = np.concatenate([chain, np.stack([np.arange(8), np.arange(2, 10)], axis=1)])
    trusted, part = np.ones(len(tried), bool), np.zeros(10, int)
    near = np.append(tried, [[2, 6], [0, 9]], axis=0)
    overlap = np.append(np.full(len(tried), 0.3), [0.9, 0.4])
    pairs = next_pairs(tried, trusted, near, overlap, part, RNG).tolist()
    assert [0, 9] in pairs
    assert [2, 6] not in pairs  # two pairs away, and both are held by four
    assert len(next_pairs(tried, trusted, near, 0 * overlap, part, RNG)) == 0


def test_a_loop_is_not_closed_by_scans_that_share_little():
    steps = [np.stack([np.arange(20 - k), np.arange(k, 20)], axis=1) for k in (1, 2, 3)]
    tried, part = np.concatenate(steps), np.zeros(20, int)
    trusted, near = np.ones(len(tried), bool), np.array([[0, 19]])
    for overlap, pairs in ((0.25, []), (0.35, [[0, 19]])):
        share = np.array([overlap])
        found = next_pairs(tried, trusted, near, share, part, RNG)
        assert found.tolist() == pairs


def test_of_long_loops_that_of_larger_overlap_is_closed():
    chain = np.stack([np.arange(99), np.arange(1, 100)], axis=1)
    trusted, part = np.ones(len(chain), bool), np.zeros(100, int)
    near, overlap = np.array([[0, 40], [0, 90], [45, 90]]), np.array([0.5, 0.4, 0.6])
    pairs = next_pairs(chain, trusted, near, overlap, part, RNG)
    assert pairs.tolist() == [[0, 40], [45, 90]]


def test_the_first_pairs_are_of_scans_that_look_alike():
    # Scans of four kinds, in turns.
    words = np.repeat(np.eye(4), 15, axis=0).reshape(4, 15, 4).swapaxes(0, 1)
    words = words.reshape(60, 4) + 0.01 * RNG.standard_normal((60, 4))
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    near = np.argsort(np.linalg.norm(words[:, None] - words, axis=2))[:, 1]
    pairs = first_pairs(60, "any", RNG, words)
    assert len(pairs) < len(first_pairs(60, "any", RNG))
    i, j = pairs.T
    in_order = j - i == 1
    assert np.sum(in_order) == 59
    same = i % 4 == j % 4
    # The most alike is of its own kind, and of the 20 that one is drawn from 14 are.
    assert np.sum(same[~in_order]) >= 60
    best = np.sort(np.stack([np.arange(60), near], axis=1), axis=1)
    assert {tuple(x) for x in best} <= {tuple(x) for x in pairs}


def test_scans_that_come_later_are_paired_by_what_they_look_like():
    words = np.repeat(np.eye(4), 15, axis=0).reshape(4, 15, 4).swapaxes(0, 1)
    words = words.reshape(60, 4) + 0.01 * RNG.standard_normal((60, 4))
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    pairs = first_pairs(60, "any", RNG, words, since=55)
    assert np.all(pairs[:, 1] >= 55)
    in_order = pairs[:, 1] - pairs[:, 0] == 1
    assert np.sum(in_order) == 5
    others, count = np.unique(pairs[~in_order], return_counts=True)
    # Each new one by the most alike, and by one more.
    assert np.all(count[others >= 55] >= 1)
    assert 5 <= np.sum(~in_order) <= 10
    same = pairs[~in_order, 0] % 4 == pairs[~in_order, 1] % 4
    assert np.sum(same) >= 5
    assert first_pairs(5, "any", RNG, None, since=3).tolist() == [
        [0, 3], [0, 4], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4],
    ]  # fmt: skip


def test_parts_are_joined_where_scans_look_alike():
    tried = all_pairs(5)
    part, trusted = np.array([0, 0, 0, 0, 0, 5]), np.ones(len(tried), bool)
    words = np.array([[1, 0], [0, 1], [0.9, 0.1], [0.1, 0.9], [0, 1], [1, 0]], float)
    pairs = next_pairs(tried, trusted, *NONE, part, RNG, words)
    assert pairs.tolist() == [[0, 5], [2, 5], [3, 5]]
    assert len(next_pairs(tried, trusted, *NONE, part, RNG)) == 3
