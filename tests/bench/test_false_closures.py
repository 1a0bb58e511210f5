"""The workload of false closures adds what it says, and counts who trusts it."""

import jax.numpy as jnp
import numpy as np
import pytest

from bench.peers.pose_graphs import Found
from bench.records import Key, Row
from bench.trajectories import trajectories
from bench.workloads.false_closures import (
    closures,
    judge,
    with_false_closures,
)
from jaxreg.graph import PoseGraph


NUM = 40


@pytest.fixture
def clean() -> tuple[PoseGraph, np.ndarray]:
    """A ring in the plane, each pose measured from the next two, and its poses."""
    angle = 2 * np.pi * np.arange(NUM) / NUM
    c, s, one, nil = np.cos(angle), np.sin(angle), np.ones(NUM), np.zeros(NUM)
    T = np.array([[c, -s, 9 * c], [s, c, 9 * s], [nil, nil, one]]).transpose(2, 0, 1)
    T = np.linalg.inv(T[0]) @ T
    steps = np.arange(NUM)
    edges = np.concatenate([np.stack([steps[:-k], steps[k:]], axis=1) for k in (1, 2)])
    T_i_j = np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    information = np.tile(np.eye(3), (len(edges), 1, 1))
    graph = PoseGraph.from_edges(
        edges, T_i_j.astype(np.float32), NUM, information=information.astype(np.float32)
    )
    return graph, T


def test_a_share_of_the_true_closures_is_added(clean):
    graph, T = clean
    trial = with_false_closures(graph, 0.5, seed=0)
    edges, true = np.asarray(trial.graph.edges), len(graph.edges)
    assert trial.false.sum() == 19  # of 38
    np.testing.assert_array_equal(trial.graph.T_i_j[:true], graph.T_i_j)
    assert not trial.false[:true].any()
    i, j = edges[trial.false].T
    assert np.all(j - i >= NUM // 20)
    # Each has the motion of some true closure.
    motions = np.asarray(graph.T_i_j)[closures(graph.edges)]
    for T_i_j in np.asarray(trial.graph.T_i_j)[trial.false]:
        assert (motions == T_i_j).all(axis=(1, 2)).any()
    np.testing.assert_allclose(trial.T_odometry, T, atol=1e-4)


def test_errors_are_distances_and_counts_are_of_closures(clean):
    graph, T = clean
    trial = with_false_closures(graph, 0.5, seed=0)
    moved = T.copy()
    moved[7, :2, 2] += (3, 4)
    weight = np.where(trial.false, 0.0, 1.0)
    weight[np.flatnonzero(trial.false)[:2]] = 1
    weight[np.flatnonzero(closures(trial.graph.edges))[:3]] = 0
    weight[0] = 0  # of the odometry: not counted
    found = Found(moved, weight)
    judged = judge(graph, jnp.asarray(T, jnp.float32), [trial], [found], draw=True)
    values = {m.key: m.value for m in judged.metrics}
    assert values["false trusted"] == 2
    assert values["true lost"] == 3
    assert values["e_t_max"] == pytest.approx(5, rel=0.05)
    assert values["ratio"] > 2
    assert len(judged.samples["x"]) == len(judged.samples["y"]) == NUM


def test_the_picture_is_of_rows_with_positions(clean, tmp_path):
    graph, T = clean
    trial = with_false_closures(graph, 0.5, seed=0)
    rows = []
    for method in ("odometry", "jaxreg default"):
        found = [Found(T, None)]
        judged = judge(graph, jnp.asarray(T, jnp.float32), [trial], found, draw=True)
        key = Key("full", "false_closures", "ring", method)
        metrics = {m.key: m for m in judged.metrics}
        rows.append(Row(key, "jaxreg", "ok", metrics=metrics, samples=judged.samples))
    path = trajectories(rows, tmp_path / "picture.png")
    assert path is not None
    assert path.read_bytes()[:4] == b"\x89PNG"
    bare = [Row(rows[0].key, "jaxreg", "ok")]
    assert trajectories(bare, tmp_path / "nothing.png") is None
    assert not (tmp_path / "nothing.png").exists()
