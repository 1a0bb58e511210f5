import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.averaging.start import closures
from jaxreg.averaging.start.drift import drifted
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import motions, rotations


LAP, NUM = 40, 80
# Compiled once: all graphs have the same number of edges.
without_doubtful_closures = eqx.filter_jit(closures.without_doubtful_closures)
confirmed = eqx.filter_jit(closures.confirmed)


def two_laps(closures: np.ndarray, wrong: np.ndarray):
    """A circle of radius 6 m walked twice, 3D, with noise; weights are 2.

    Args:
        closures: `(42, 2)` frames.
        wrong: `(42,)` closures that get random motions.
    """
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(NUM) / LAP
    zero, c, s = np.zeros(NUM), np.cos(angle), np.sin(angle)
    R = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], 1).reshape(-1, 3, 3)
    X = motions(R, 6 * np.stack([s, 1 - c, zero], axis=1))
    chain = np.stack([np.arange(NUM - 1), np.arange(1, NUM)], axis=1)
    edges = np.concatenate([chain, closures])
    noise = motions(
        rotations(rng, len(edges), 3, 0.01), 0.02 * rng.normal(size=(len(edges), 3))
    )
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ noise
    count = int(wrong.sum())
    T[len(chain) :][wrong] = motions(
        rotations(rng, count, 3, None), rng.uniform(-6, 6, (count, 3))
    )
    graph = PoseGraph.from_edges(
        edges, T.astype(np.float32), NUM, weight=np.full(len(edges), 2, np.float32)
    )
    return graph, np.concatenate([np.zeros(len(chain), bool), wrong])


def test_a_lone_closure_among_confirmed_ones_is_doubted():
    again = np.stack([np.arange(LAP), LAP + np.arange(LAP)], axis=1)
    again[::2] = again[::2, ::-1]  # either frame may be the first
    # One stands alone, one beside right ones that it contradicts.
    closures = np.concatenate([again, [[3, 25], [12, 51]]])
    graph, wrong = two_laps(closures, np.arange(len(closures)) >= LAP)
    weight = np.asarray(without_doubtful_closures(graph).weight)
    np.testing.assert_array_equal(weight[~wrong], 2)
    np.testing.assert_array_equal(weight[wrong], 0)


def _agree(first: tuple[int, int], second: tuple[int, int], apart: float) -> np.ndarray:
    """Which of two false closures are confirmed that ask for motions so far apart."""
    angle = 2 * np.pi * np.arange(NUM) / LAP
    R = Rotation.from_euler("z", angle[:, None]).as_matrix()
    X = motions(R, np.stack([np.sin(angle), 1 - np.cos(angle), 0.1 * angle], axis=1))
    X = np.linalg.inv(X[0]) @ X
    chain = np.stack([np.arange(NUM - 1), np.arange(1, NUM)], axis=1)
    edges = np.concatenate([chain, [first], [second]])
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    # A gap between the chained places of both ends.
    for e, gap in ((-2, 0.7), (-1, 0.7 + apart)):
        i, j = np.sort(edges[e])
        turned = motions(np.eye(3)[None], np.array([[gap, 0.3, 0.2]]))[0]
        T[e] = np.linalg.inv(X[i]) @ turned @ X[j]
        if edges[e, 0] > edges[e, 1]:
            T[e] = np.linalg.inv(T[e])
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), NUM)
    closure = jnp.arange(len(edges)) >= len(chain)
    found = np.asarray(confirmed(graph, closure))
    assert not found[: len(chain)].any()
    return found[len(chain) :]


@pytest.mark.parametrize(
    ("second", "apart", "expected"),
    [
        ((14, 66), 0.0, True),
        ((66, 14), 0.0, True),
        ((14, 66), 1.0, False),  # asks for another motion
        ((14, 69), 0.0, False),  # ends too far away
        ((18, 62), 0.0, False),
    ],
)
def test_a_closure_is_confirmed_by_one_beside_it_that_asks_for_the_same(
    second, apart, expected
):
    np.testing.assert_array_equal(_agree((9, 60), second, apart), expected)


def test_a_frame_is_not_lost_with_its_lone_closure():
    closures = np.stack([np.arange(LAP), LAP + np.arange(LAP)], axis=1)
    # The walk is cut before its last frame, which a lone closure alone holds.
    closures = np.concatenate([closures[:-1], [[3, 25], [5, NUM - 1], [12, 51]]])
    graph, _ = two_laps(closures, np.zeros(len(closures), bool))
    cut = np.arange(graph.num_edges) == NUM - 2
    graph = eqx.tree_at(lambda g: g.weight, graph, jnp.where(cut, 0, graph.weight))
    weight = np.asarray(without_doubtful_closures(graph).weight)
    held = (graph.edges == NUM - 1).any(axis=1) & ~cut
    assert 0 < weight[held].item() < 0.01


def test_where_no_closure_is_confirmed_none_is_left_out_for_standing_alone():
    first = np.arange(LAP + 2) % LAP
    closures = np.stack([first, first + 4 + (17 * first) % 36], axis=1)
    graph, wrong = two_laps(closures, np.ones(LAP + 2, bool))
    allowed = ~np.asarray(drifted(graph, jnp.asarray(wrong)))
    assert np.sum(allowed & wrong) > LAP / 2
    weight = np.asarray(without_doubtful_closures(graph).weight)
    np.testing.assert_array_equal(weight[allowed], 2)
    np.testing.assert_array_equal(weight[~allowed], 0)


def test_where_the_numbers_of_frames_tell_no_order_all_keep_their_weight():
    again = np.stack([np.arange(LAP), LAP + np.arange(LAP)], axis=1)
    closures = np.concatenate([again, [[3, 25], [12, 51]]])
    graph, _ = two_laps(closures, np.arange(len(closures)) >= LAP)
    name = np.random.default_rng(0).permutation(NUM).astype(np.int32)
    named = eqx.tree_at(lambda g: g.edges, graph, jnp.asarray(name)[graph.edges])
    weight = without_doubtful_closures(named).weight
    np.testing.assert_array_equal(weight, graph.weight)


def test_a_chain_without_closures_keeps_its_weights():
    graph, _ = two_laps(np.tile([0, LAP], (LAP + 2, 1)), np.zeros(LAP + 2, bool))
    chain = np.arange(graph.num_edges) < NUM - 1
    weight = jnp.where(chain, graph.weight, 0)
    graph = eqx.tree_at(lambda g: g.weight, graph, weight)
    np.testing.assert_array_equal(without_doubtful_closures(graph).weight, weight)
