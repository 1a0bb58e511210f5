"""Edges on the way between two nodes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from jaxreg.graph.hops import hops


@given(st.integers(0, 1_000), st.integers(2, 150), st.floats(0, 3), st.integers(1, 9))
def test_hops_are_those_of_shortest_paths(seed, num, degree, most):
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, num, (int(degree * num / 2), 2))
    pairs = rng.integers(0, num, (200, 2))
    ways = coo_array((np.ones(len(edges)), edges.T), (num, num)).tocsr()
    told = dijkstra(ways, directed=False, unweighted=True)[*pairs.T]
    np.testing.assert_array_equal(hops(edges, pairs, num, most), np.minimum(told, most))


def test_of_no_pairs_nothing_is_told():
    none = np.zeros((0, 2), int)
    assert hops(none, none, 4, 3).shape == (0,)
