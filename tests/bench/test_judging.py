"""What judges answers finds the errors that were put in."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from bench import plots
from bench.peers.pose_graphs import Found
from bench.records import Key, Metric, Row
from bench.start_plot import REST, bar
from bench.workloads.command_line import judge_pair
from bench.workloads.false_closures import closures, judge, with_false_closures
from bench.workloads.filter_data import cube, horse, horse_model
from bench.workloads.filter_paper import judge as judge_poses
from bench.workloads.filter_paper import judge_table
from jaxreg.graph import PoseGraph


NUM = 40


def test_columns_of_table_1_are_those_of_known_errors():
    trials = horse(4, 0.05, horse_model(None))
    theta, shift = [1.0, -3.0, 2.0, -12.0], [1.0, 2.0, 6.0, 3.0]
    away = np.linalg.inv(trials.T_target_source)
    for pose, angle, x in zip(away, np.deg2rad(theta), shift, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        pose[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]] @ pose[:3, :3]
        pose[0, 3] += x
    judged = judge_table(trials, list(np.linalg.inv(away)))
    found = {m.key: m.value for m in judged.metrics}
    assert found == pytest.approx(
        {
            "success": 50,  # one is too far off, one turned too far
            "t_mean": 3,
            "t_dev": np.std(shift),
            "t_max": 6,
            "theta_mean": -3,
            "theta_dev": np.std(theta),
            "theta_max": 12,
            "e_rot": 2.5,
        }
    )


def test_a_pose_that_looks_the_same_is_told_apart_from_the_right_one():
    trials = cube(5)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    truth = trials.T_target_source
    judged = judge_poses(trials, [*truth[:2], *(quarter @ truth[2:4]), np.eye(4)])
    found = {m.key: m.value for m in judged.metrics}
    assert (found["success"], found["as_shape"]) == (40, 80)


def test_errors_are_distances_and_counts_are_of_closures():
    # A ring in the plane, each pose measured from the next two.
    angle = 2 * np.pi * np.arange(NUM) / NUM
    c, s, one, nil = np.cos(angle), np.sin(angle), np.ones(NUM), np.zeros(NUM)
    T = np.array([[c, -s, 9 * c], [s, c, 9 * s], [nil, nil, one]]).transpose(2, 0, 1)
    T = np.linalg.inv(T[0]) @ T
    steps = np.arange(NUM)
    edges = np.concatenate([np.stack([steps[:-k], steps[k:]], axis=1) for k in (1, 2)])
    T_i_j = (np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]).astype(np.float32)
    information = np.tile(np.eye(3, dtype=np.float32), (len(edges), 1, 1))
    graph = PoseGraph.from_edges(edges, T_i_j, NUM, information=information)
    trial = with_false_closures(graph, 0.5, seed=0)
    assert trial.false.sum() == 19  # of 38
    moved = T.copy()
    moved[7, :2, 2] += (3, 4)
    weight = np.where(trial.false, 0.0, 1.0)
    weight[np.flatnonzero(trial.false)[:2]] = 1
    weight[np.flatnonzero(closures(trial.graph.edges))[:3]] = 0
    weight[0] = 0  # of the odometry: not counted
    found = Found(moved, weight)
    judged = judge(graph, jnp.asarray(T, jnp.float32), [trial], [found], draw=False)
    values = {m.key: m.value for m in judged.metrics}
    assert values["false trusted"] == 2
    assert values["true lost"] == 3
    assert values["e_t_max"] == pytest.approx(5, rel=0.05)


def test_a_command_is_drawn_by_the_parts_of_its_time(tmp_path: Path):
    told = {"trace": 1.0, "load": 0.5, "run": 2.0, "write": 0.25}
    answers = [
        {"status": "CONVERGED", "times_s": {"read": 0.1, **told}},
        {"status": "CONVERGED", "times_s": {"generate": 0.3, **told, "load": 1.5}},
        {"status": "LOW_OVERLAP", "times_s": {"read": 0.2, **told, "compile": 4.0}},
    ]
    metrics = {m.key: m for m in judge_pair(answers).metrics}
    assert metrics["believed"].value == pytest.approx(200 / 3)
    assert (metrics["read"].value, metrics["load"].value) == (0.2, 0.5)
    metrics["wall_ms"] = Metric("wall_ms", 5_000.0, "ms", "down")
    key = Key("full", "command_line", "two scans", "jaxreg register")
    row = Row(key, "jaxreg", "ok", metrics=metrics)
    parts = bar(row)
    assert sum(parts.values()) == pytest.approx(5)
    assert (parts[REST], parts["compile"]) == (pytest.approx(1.05), 0)
    assert plots.draw("command_line", "full", [row], tmp_path) == [
        tmp_path / "command_line.png"
    ]
    assert plots.draw("command_line", "full", [], tmp_path) == []
