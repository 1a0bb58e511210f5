"""The choice of the exact index."""

import pytest

from jaxreg.neighbours import BoxTree, BruteForce, exact_index


@pytest.mark.parametrize("num", [1, 200, 2_000, 4_096])
def test_few_targets_are_compared_one_by_one(num):
    assert exact_index(num) is BruteForce


@pytest.mark.parametrize("num", [8_000, 100_000, 10**7])
def test_many_targets_go_into_a_tree(num):
    assert exact_index(num) is BoxTree
