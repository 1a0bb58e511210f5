"""Which pairs are registered."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from jaxreg.multiview.choose_pairs import all_pairs, first_pairs, most_pairs, next_pairs


RNG = np.random.default_rng(0)


def _symmetric(num: int, pairs: np.ndarray) -> np.ndarray:
    out = np.zeros((num, num), bool)
    out[pairs[:, 0], pairs[:, 1]] = True
    return out | out.T


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
    assert connected_components(_symmetric(60, pairs))[0] == 1
    if order == "sequential":
        assert np.all(pairs[:, 1] - pairs[:, 0] <= 2)


def test_parts_are_joined_by_pairs_that_were_not_tried():
    tried = _symmetric(6, np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]))
    trusted = _symmetric(6, np.array([[0, 1], [1, 2], [2, 3], [4, 5]]))
    part = np.array([0, 0, 0, 0, 4, 4])
    pairs = next_pairs(tried, trusted, np.zeros((6, 6)), part, RNG)
    assert len(pairs) >= 2
    assert np.all((pairs[:, 0] < 4) & (pairs[:, 1] >= 4))
    assert not tried[pairs[:, 0], pairs[:, 1]].any()


def test_a_scan_that_hangs_by_a_thread_gets_the_pair_that_overlaps_most():
    trusted = _symmetric(6, np.concatenate([all_pairs(5), [[0, 5]]]))
    likely = np.zeros((6, 6))
    likely[5, 1:5] = likely[1:5, 5] = [0.3, 0.6, 0.1, 0.4]
    pairs = next_pairs(trusted, trusted, likely, np.zeros(6, int), RNG)
    assert pairs.tolist() == [[2, 5]]
    likely[2, 5] = likely[5, 2] = likely[1, 5] = likely[5, 1] = 0.19  # unlikely
    pairs = next_pairs(trusted, trusted, likely, np.zeros(6, int), RNG)
    assert pairs.tolist() == [[4, 5]]


def test_a_loop_is_closed_where_the_poses_say_that_scans_overlap():
    chain = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    near = np.stack([np.arange(8), np.arange(2, 10)], axis=1)
    trusted = _symmetric(10, np.concatenate([chain, near]))
    likely = 0.3 * trusted
    likely[0, 9] = likely[9, 0] = 0.4
    pairs = next_pairs(trusted, trusted, likely, np.zeros(10, int), RNG)
    assert [0, 9] in pairs.tolist()
    assert len(next_pairs(trusted, trusted, 0 * likely, np.zeros(10, int), RNG)) == 0
