"""Edges of the same frames, and loops of three, against dense tables."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.graph.joined import in_loops_of_three, joined


NUM_FRAMES, NUM_EDGES = 70, 120
_JOINED = jax.jit(joined)
_LOOPS = jax.jit(in_loops_of_three, static_argnums=2)


def _edges(seed: int, num_frames: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, num_frames, (NUM_EDGES, 2)).astype(np.int32)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), num_frames=st.integers(2, NUM_FRAMES))
def test_edges_of_the_same_frames_share_a_row(seed: int, num_frames: int):
    edges = _edges(seed, num_frames)
    found = _JOINED(edges)
    _, first, row = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_inverse=True
    )
    np.testing.assert_array_equal(found.row, row)
    np.testing.assert_array_equal(np.flatnonzero(found.first), np.sort(first))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), num_frames=st.integers(3, NUM_FRAMES))
def test_loops_are_those_of_a_dense_table(seed: int, num_frames: int):
    edges = _edges(seed, num_frames)
    i, j = edges.T
    first = np.asarray(_JOINED(edges).first)
    present = first & (i != j) & (np.random.default_rng(seed).random(NUM_EDGES) < 0.7)
    beside = np.zeros((NUM_FRAMES, NUM_FRAMES), int)
    beside[i[present], j[present]] = beside[j[present], i[present]] = 1
    expected = present & ((beside @ beside)[i, j] > 0)
    found = _LOOPS(edges, present, NUM_FRAMES)
    np.testing.assert_array_equal(found, expected)
