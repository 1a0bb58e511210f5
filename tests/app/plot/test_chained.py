"""Poses to compare an answer with."""

import numpy as np
import pytest

import jaxreg as jr
from jaxreg.app.plot.chained import chained
from jaxreg.testing.problems import motion


@pytest.mark.parametrize("d", [2, 3])
def test_motions_are_chained_along_the_shortest_paths_whichever_way_they_point(d):
    num = 7
    T = np.stack([motion(d, 0.5 * k, 1.0, k) for k in range(num)])
    T = np.linalg.inv(T[0]) @ T

    def between(i: int, j: int) -> np.ndarray:
        return np.linalg.inv(T[i]) @ T[j]

    wrong = motion(d, 1.0, 3.0, 9)
    # Forwards and back; the wrong ones are longer ways, one beside a better motion.
    edges = [(0, 1), (2, 1), (2, 3), (3, 0), (1, 0), (5, 6)]
    right = [True, True, True, False, False, True]
    weight = [1.0, 1.0, 1.0, 0.1, 0.5, 1.0]
    motions = [
        between(i, j) if ok else wrong for (i, j), ok in zip(edges, right, strict=True)
    ]
    graph = jr.PoseGraph.from_edges(edges, motions, num_poses=num, weight=weight)
    before = chained(graph, jr.average(graph, jr.SpanningTree()))
    reached = np.arange(num) < 4
    np.testing.assert_array_equal(before.placed, reached)
    np.testing.assert_allclose(before.T_world_i[reached], T[reached], atol=1e-5)
    eye = np.broadcast_to(np.eye(d + 1), (3, d + 1, d + 1))
    np.testing.assert_array_equal(before.T_world_i[~reached], eye)


def test_a_frame_that_nothing_joins_is_alone():
    for edges in ([(1, 2)], np.zeros((0, 2), int)):
        motions = np.tile(motion(3, 0.3, 1.0, 1), (len(edges), 1, 1))
        graph = jr.PoseGraph.from_edges(edges, motions, num_poses=3)
        before = chained(graph, jr.average(graph, jr.SpanningTree()))
        np.testing.assert_array_equal(before.placed, [True, False, False])
        np.testing.assert_array_equal(before.T_world_i, np.tile(np.eye(4), (3, 1, 1)))
