"""Pairs and sequences of sensors: read, judged and told as they were made."""

from pathlib import Path

import numpy as np
import pytest

from bench.case import Options
from bench.pair_table import pair_table
from bench.records import Key, Metric, Row
from bench.studies.evidence import Examples, fitted
from bench.studies.reliability import Reliability
from bench.workloads import (
    sensor_data,
    sensor_guesses,
    sensor_pairs,
    sensor_sequences,
)
from bench.workloads.sensor_data import Answer, Sequence


def _shifted(x: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, 0, 0
    return T


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A pair without a guess, one with, and a sequence of two scans."""
    folder = tmp_path / "sensor_pairs"
    folder.mkdir()
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    known = {
        "source": points,
        "target": points[:40] + np.array([2, 0, 0], np.float32),
        "T_target_source": _shifted(2),
        "tolerance": 0.1,
        "kind": "lidar",
        "voxel": 0.5,
        "camera_at_origin": True,
        "note": "made",
    }
    np.savez(folder / "a.npz", **known)
    np.savez(folder / "b.npz", **known, T_init=_shifted(1.5))
    scans = {"scan_00": points, "scan_01": points + np.array([0, 1, 0], np.float32)}
    poses = np.stack([np.eye(4), _shifted(1)])
    told = {"voxel": 0.5, "least": 0.3, "camera_at_origin": True}
    np.savez(folder / "seq_c.npz", T_world_i=poses, **scans, **told)
    return tmp_path


def test_cases_are_those_of_the_files(data: Path):
    options = Options(quick=False, data=data)
    assert [c.name for c in sensor_pairs.cases(options)] == ["a", "b"]
    assert [c.name for c in sensor_guesses.cases(options)] == ["b"]
    assert next(sensor_sequences.cases(options)).name == "c"
    assert not list(sensor_pairs.cases(Options(quick=False, data=data / "none")))


def test_answers_are_right_within_the_tolerance_and_counted_if_believed(data: Path):
    case = next(iter(sensor_pairs.cases(Options(quick=False, data=data))))
    poses = _shifted(2.05), _shifted(2.05), _shifted(2.2)
    believed = True, False, True
    told = [Answer(T, b, 0.5, 1.0) for T, b in zip(poses, believed, strict=True)]
    judged = case.judge(told)
    found = {m.key: m.value for m in judged.metrics}
    assert found["right"] == pytest.approx(200 / 3)
    assert found["right and believed"] == pytest.approx(100 / 3)
    assert found["wrong and believed"] == 1
    assert found["e_trans"] == pytest.approx(0.05)
    assert (found["overlap"], found["log_evidence"]) == (0.5, 1)
    assert judged.samples == {"right": [1, 1, 0], "believed": [1, 0, 1]}


def test_a_guess_is_where_a_peer_starts(data: Path):
    def peer(source: np.ndarray, target: np.ndarray, voxel: float) -> np.ndarray:
        return _shifted(float((target - source[:40]).mean(axis=0)[0]))

    told = sensor_data.sensor_pairs(data)[1]
    assert told.T_init is not None
    T = sensor_guesses.from_guess(peer, told, told.T_init, 0)
    np.testing.assert_allclose(T, _shifted(2), atol=1e-6)
    assert sensor_guesses.met(told, T)
    assert not sensor_guesses.met(told, _shifted(20))


def test_scans_of_the_largest_group_are_judged_in_the_frame_of_its_first():
    T = np.stack([_shifted(x) for x in range(5)])
    scans = [np.zeros((1, 3))] * 5
    data = Sequence("made", scans, T, 0.5, 0.3, True)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    found = quarter @ T
    found[3] = found[3] @ _shifted(1)
    judged = sensor_sequences.judge(data, [(np.array([1, 0, 0, 0, -1]), found)])
    told = {m.key: m.value for m in judged.metrics}
    assert (told["placed"], told["wrong"]) == (3, 1)
    assert told["e_t"] == pytest.approx(1000 / 3)


def test_a_table_has_a_line_for_each_pair_and_sums_at_the_end():
    def row(pair: str, right: list, believed: list) -> Row:
        known = {"e_rot": 0.25, "e_trans": 0.01, "cpu_ms": 1500.0, "log_evidence": 3.0}
        metrics = {k: Metric(k, v, "", "down") for k, v in known.items()}
        samples = {"right": right, "believed": believed}
        key = Key("full", "sensor_pairs", pair, "jaxreg")
        return Row(key, "jaxreg", "ok", metrics=metrics, samples=samples, run="r")

    absent = Row(Key("full", "sensor_pairs", "a", "peer"), "open3d", "absent")
    rows = [row("a", [1, 0], [1, 1]), row("b", [1, 1], [0, 1]), absent]
    lines = list(pair_table(rows))
    assert "| a | R+w+ 0.25, 0.01; 1.5 s | absent | 3 |  |" in lines
    assert "| wrong and believed | 1 of 4 |  | | |" in lines


def test_bins_tell_how_far_probabilities_are_off():
    probability = np.repeat([0.25, 0.75, 1.0], 4)
    right = np.array([0, 0, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1.0])
    found = Reliability.of(probability, right)
    assert found.num.tolist() == [0, 0, 4, 0, 0, 0, 0, 4, 0, 4]
    assert found.error == pytest.approx(0.25 / 3)


def test_the_discriminant_is_the_ratio_of_two_normal_laws():
    rng, mean = np.random.default_rng(0), np.array([[0.0, 0.0], [2.0, 1.0]])
    right = rng.integers(0, 2, 20_000).astype(float)
    numbers = mean[right.astype(int)] + rng.normal(size=(20_000, 2))
    examples = Examples(numbers, right, np.arange(20_000))
    assert fitted([examples]) == pytest.approx([2, 1, -2.5], abs=0.1)
