"""`average(previous=)`: a graph that grows."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import Status
from jaxreg.averaging import Correntropy, PoseGraphLM, average
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.many import average_rounded
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import motions, rotations


# Sizes that programs are rounded to, so that few compile: 381 edges and 3 closures.
NUM, OLD, TURN, SHIFT = 192, 182, 0.005, 0.01


def _drive() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses on a circle in 2D, edges to the next two frames, and their motions."""
    angle = 2 * np.pi * np.arange(NUM) / NUM
    c, s = np.cos(angle), np.sin(angle)
    R = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    X = motions(R, 30 * np.stack([s, 1 - c], axis=1))
    step = np.arange(NUM)
    edges = np.concatenate([np.stack([step[:-k], step[k:]], 1) for k in (1, 2)])
    late = np.max(edges, axis=1) >= OLD
    edges = edges[np.argsort(late, kind="stable")]
    return X, edges, _measured(X, edges, 0), late


def _measured(X: np.ndarray, edges: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    num = len(edges)
    noise = motions(rotations(rng, num, 2, TURN), SHIFT * rng.normal(size=(num, 2)))
    return np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ noise


X, EDGES, T_I_J, LATE = _drive()
NUM_OLD = int(np.sum(~LATE))


def graph(num: int, edges: np.ndarray, T: np.ndarray) -> PoseGraph:
    information = np.diag([SHIFT**-2, SHIFT**-2, TURN**-2]).astype(np.float32)
    information = np.broadcast_to(information, (len(edges), 3, 3))
    return PoseGraph.from_edges(edges, T.astype(np.float32), num, None, information)


def grown(closures: list[tuple[int, int]], wrong: bool = False) -> PoseGraph:
    """With three more edges."""
    more = np.array(closures)
    T = _measured(X, more, 1)
    if wrong:
        T[:, :2, 2] += [4.0, -3.0]
    return graph(NUM, np.concatenate([EDGES, more]), np.concatenate([T_I_J, T]))


NEAR = [(184, 187), (185, 188), (186, 189)]
FAR = [(3, 190), (4, 190), (4, 191)]


@pytest.fixture(scope="module")
def old() -> AveragingSolution:
    before = graph(OLD, EDGES[:NUM_OLD], T_I_J[:NUM_OLD])
    # By the program of the graph that has grown.
    return average_rounded(before, Correntropy(), None, None)


def apart(T: jax.Array, T_other: jax.Array) -> float:
    """The largest difference, in deviations of an edge."""
    gap = np.linalg.inv(np.asarray(T)) @ np.asarray(T_other) - np.eye(3)
    turn = np.abs(gap[:, :2, :2]).max() / TURN
    return max(float(turn), float(np.abs(gap[:, :2, 2]).max() / SHIFT))


def test_appended_frames_are_where_averaging_anew_puts_them(old: AveragingSolution):
    new = grown(NEAR)
    found, anew = average(new, previous=old), average(new)
    assert found.status == Status.CONVERGED
    assert found.T_world_i.shape == (NUM, 3, 3)
    assert apart(found.T_world_i, anew.T_world_i) < 0.2
    np.testing.assert_allclose(found.edge_weight, anew.edge_weight, atol=0.05)
    np.testing.assert_allclose(found.log_evidence, anew.log_evidence, rtol=1e-3)
    # What is far from the new stands still.
    assert apart(found.T_world_i[:150], old.T_world_i[:150]) < 1e-2
    assert apart(found.T_world_i[:OLD], old.T_world_i) > 1e-3
    again = average(new, previous=found)
    assert apart(again.T_world_i, found.T_world_i) < 0.05


def test_a_closure_bends_all_of_a_long_chain(old: AveragingSolution):
    new = grown(FAR)
    found, anew = average(new, previous=old), average(new)
    assert np.all(found.edge_weight > 0.5)
    assert apart(old.T_world_i[60:120], anew.T_world_i[60:120]) > 1
    assert apart(found.T_world_i, anew.T_world_i) < 0.2


def test_wrong_closures_are_not_trusted(old: AveragingSolution):
    new = grown([(20, 183), (80, 190), (140, 187)], wrong=True)
    found = average(new, previous=old)
    assert np.all(found.edge_weight[-3:] < 0.1)
    assert np.all(found.edge_weight[:-3] > 0.5)


def test_the_answer_is_in_the_frame_of_the_previous(old: AveragingSolution):
    T_other_world = motions(rotations(np.random.default_rng(0), 1, 2, 1.0), SOME)[0]
    moved = jnp.asarray(T_other_world, jnp.float32) @ old.T_world_i
    there = dataclasses.replace(old, T_world_i=moved)
    for closures, wrong in ((NEAR, False), ([(9, 183), (8, 190), (7, 187)], True)):
        new = grown(closures, wrong=wrong)
        found = average(new, previous=there)
        usual = T_other_world @ np.asarray(average(new, previous=old).T_world_i)
        np.testing.assert_allclose(found.T_world_i, usual, atol=1e-3)


SOME = np.array([[3.0, -2.0]])


def test_nothing_new_changes_nothing(old: AveragingSolution):
    same = graph(OLD, EDGES[:NUM_OLD], T_I_J[:NUM_OLD])
    found = average(same, previous=old)
    np.testing.assert_allclose(found.T_world_i, old.T_world_i, atol=1e-4)
    np.testing.assert_allclose(found.edge_weight, old.edge_weight, atol=1e-4)


@pytest.mark.parametrize("method", [Correntropy(), PoseGraphLM()])
def test_small_graphs_and_other_methods_start_from_the_poses_before(method):
    few = (EDGES < 12).all(axis=1)
    edges, T = EDGES[few], T_I_J[few]
    # Ten frames and twelve are rounded to one size.
    order = np.argsort((edges >= 10).any(axis=1), kind="stable")
    edges, T = edges[order], T[order]
    first = (edges < 10).all(axis=1)
    small = average(graph(10, edges[first], T[first]), method)
    new = graph(12, edges, T)
    found, anew = average(new, method, previous=small), average(new, method)
    assert apart(found.T_world_i, anew.T_world_i) < 0.2


def test_what_is_no_previous_solution_is_refused(old: AveragingSolution):
    new, less = grown(NEAR), graph(OLD - 1, EDGES[:100], T_I_J[:100])
    T = np.tile(np.eye(3, dtype=np.float32), (NUM, 1, 1))
    cases = [
        (TypeError, "previous", new, {"previous": T}),
        (ValueError, "init: wanted None", new, {"init": T}),
        (ValueError, "priors: wanted None", new, {"priors": [(0, T[0])]}),
        (ValueError, "fixed: wanted None", new, {"fixed": [(0, T[0])]}),
        (ValueError, "previous: of one graph", [new], {}),
        (ValueError, "previous: wanted at most 181 frames", less, {}),
    ]
    for error, told, of, arguments in cases:
        with pytest.raises(error, match=re.escape(told)):
            average(of, **{"previous": old, **arguments})
    solid = PoseGraph.from_edges([(0, NUM)], np.eye(4, dtype=np.float32)[None])
    with pytest.raises(ValueError, match=re.escape("shape (v, 4, 4), found")):
        average(solid, previous=old)
    with pytest.raises(ValueError, match="under jit"):
        jax.jit(lambda s: average(new, previous=s).status)(old)
    told = dataclasses.replace(old, prior_weight=jnp.ones(1))
    with pytest.raises(ValueError, match="without priors"):
        average(new, previous=told)
