import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import plyfile

from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.merge import merge_scans
from jaxreg.app.result import (
    Result,
    result_document,
    write_json,
    write_result,
)
from jaxreg.io import read_g2o, read_g2o_poses, read_points, read_tum


RNG = np.random.default_rng(0)


def _result(offset: float = 0.0, d: int = 3) -> tuple[Result, list[np.ndarray]]:
    """Three scans of one cloud; the last is not placed."""
    angle = 0.3
    c, s = np.cos(angle), np.sin(angle)
    T = np.tile(np.eye(d + 1), (3, 1, 1))
    T[1, :2, :2] = [[c, -s], [s, c]]
    T[1, :d, d] = np.arange(1, d + 1) + offset
    world = RNG.normal(size=(30, d)) + offset
    scans = [world, (world - T[1, :d, d]) @ T[1, :d, :d], RNG.normal(size=(9, d))]
    edges = np.array([[0, 1], [0, 2], [1, 2]])
    i, j = edges.T
    result = Result(
        names=["a", "b", "c"],
        T_world_i=T,
        component=np.array([0, 0, -1]),
        status=Status.DISCONNECTED,
        scan_status=np.array([0, 0, Status.LOW_OVERLAP]),
        num_points=np.array([30, 30, 10]),
        num_dropped=np.array([0, 0, 1]),
        edges=edges,
        T_i_j=np.linalg.inv(T)[i] @ T[j],
        overlap=np.array([0.9, 0.1, 0.2]),
        weight=np.array([0.75, 0.0, 0.0]),
        inlier_rmse=np.array([0.01, np.nan, 0.3]),
    )
    return result, scans


def _write(folder: Path, result: Result, scans: list[np.ndarray]) -> dict[str, Any]:
    document = result_document(
        result, command="jaxreg multiview x", seed=4, times={"run": 1.5}
    )
    write_result(folder, result, scans, document)
    return json.loads((folder / "result.json").read_text())


def test_result_json_says_everything(tmp_path: Path):
    result, scans = _result()
    found = _write(tmp_path, result, scans)
    assert found["names"] == ["a", "b", "c"]
    np.testing.assert_array_equal(found["T_world_i"][1], result.T_world_i[1])
    assert found["T_world_i"][2] is None
    assert found["status"] == "DISCONNECTED"
    assert found["advice"] == terminal_advice(Status.DISCONNECTED)
    assert (found["seed"], found["command"]) == (4, "jaxreg multiview x")
    assert found["times_s"] == {"run": 1.5}
    assert {"jaxreg", "jax", "numpy", "python", "device"} <= set(found["versions"])
    c = found["scans"][2]
    assert (c["placed"], c["status"]) == (False, "LOW_OVERLAP")
    assert (c["num_points"], c["num_dropped"]) == (10, 1)
    assert (c["best_pair"]["i"], c["best_pair"]["j"]) == ("b", "c")
    pair = found["pairs"][0]
    assert (pair["i"], pair["j"]) == ("a", "b")
    assert (pair["overlap"], pair["weight"]) == (0.9, 0.75)
    np.testing.assert_array_equal(pair["T_i_j"], result.T_i_j[0])
    assert found["pairs"][1]["inlier_rmse"] is None


def test_poses_graph_and_model_agree_also_far_from_the_origin(tmp_path: Path):
    result, scans = _result(offset=5e6)
    _write(tmp_path, result, scans)
    times, poses = read_tum(tmp_path / "poses.tum")
    assert times.tolist() == [0, 1]
    np.testing.assert_allclose(poses, result.T_world_i[:2], rtol=1e-6)
    text = (tmp_path / "poses.tum").read_text().splitlines()[2].split()
    np.testing.assert_allclose(
        np.array(text[1:4], float), result.T_world_i[1, :3, 3], rtol=1e-15
    )
    graph = read_g2o(tmp_path / "graph.g2o")
    assert np.asarray(graph.edges).tolist() == [[0, 1]]
    ids, _ = read_g2o_poses(tmp_path / "graph.g2o")
    assert ids.tolist() == [0, 1]
    merged = read_points(tmp_path / "merged.ply")
    assert merged.shape == (60, 3)
    # Both scans are of the same points, so they coincide in the common frame.
    np.testing.assert_allclose(merged[:30], merged[30:], atol=1e-8)


def test_another_component_is_a_model_of_its_own(tmp_path: Path):
    result, scans = _result()
    both = dataclasses.replace(
        result,
        names=list("abcde"),
        component=np.array([0, 1, -1, 1, 0]),
        T_world_i=result.T_world_i[[0, 0, 2, 1, 1]],
        scan_status=np.array([0, Status.DISCONNECTED, 3, Status.DISCONNECTED, 0]),
        num_points=np.full(5, 30),
        num_dropped=np.zeros(5, int),
        edges=np.array([[0, 4], [1, 3], [0, 1]]),
        T_i_j=result.T_i_j[[0, 0, 1]],
        weight=np.array([0.9, 0.8, 0.0]),
    )
    scans = [scans[k] for k in (0, 0, 2, 1, 1)]
    found = _write(tmp_path, both, scans)
    assert [scan["component"] for scan in found["scans"]] == [0, 1, -1, 1, 0]
    assert [scan["placed"] for scan in found["scans"]] == [True, *[False] * 3, True]
    assert [T is None for T in found["T_world_i"]] == [False, False, True, False, False]
    for name, ids in (("", [0, 4]), ("_1", [1, 3])):
        assert read_tum(tmp_path / f"poses{name}.tum")[0].tolist() == ids
        assert read_g2o_poses(tmp_path / f"graph{name}.g2o")[0].tolist() == ids
        merged = read_points(tmp_path / f"merged{name}.ply")
        np.testing.assert_allclose(merged[:30], merged[30:], atol=1e-8)


def test_2d_results_are_written(tmp_path: Path):
    result, scans = _result(d=2)
    _write(tmp_path, result, scans)
    merged = read_points(tmp_path / "merged.ply")
    np.testing.assert_allclose(merged[:30, :2], scans[0])
    assert not merged[:, 2].any()
    assert "EDGE_SE2" in (tmp_path / "graph.g2o").read_text()


def test_the_model_is_coloured_by_scan(tmp_path: Path):
    result, scans = _result()
    _write(tmp_path, result, scans)
    vertex = plyfile.PlyData.read(tmp_path / "merged.ply")["vertex"]
    red = np.asarray(vertex["red"])
    assert len(set(red[:30])) == len(set(red[30:])) == 1
    assert red[0] != red[30]


def test_large_models_are_thinned_evenly_and_keep_the_type():
    scans = [RNG.uniform(size=(4000, 3)).astype(np.float32) for _ in range(3)]
    scans[1][7] = np.nan
    T = np.tile(np.eye(4), (3, 1, 1))
    full, owner, _ = merge_scans(scans, T, np.array([True, True, False]))
    assert (full.shape, full.dtype) == ((7999, 3), np.float32)
    assert np.bincount(owner).tolist() == [4000, 3999]
    thin, owner, _ = merge_scans(scans, T, np.ones(3, bool), max_points=1000)
    assert 500 < len(thin) <= 1000
    assert len(owner) == len(thin)
    corners = (thin > 0.5) @ np.array([1, 2, 4])
    assert np.bincount(corners, minlength=8).min() > 0.5 * len(thin) / 8


def test_json_holds_no_nan(tmp_path: Path):
    write_json(tmp_path / "a.json", {"a": [np.nan, 1.0, (np.inf,)], "b": "text"})
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text) == {"a": [None, 1.0, [None]], "b": "text"}
