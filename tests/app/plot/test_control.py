"""Control points on the page: exact in map coordinates, hidden at will, in a table."""

import base64
import dataclasses
import gzip
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from helpers import blob, motion, move

import jaxreg
from jaxreg import Status
from jaxreg.app.cli.known import control_entry, known_of_scans
from jaxreg.app.plot import write_graph_report, write_report
from jaxreg.app.plot.report_parts import control_rows
from jaxreg.app.result import Result
from jaxreg.io.graphs.g2o_known import KnownOfGraph


FAR = np.array([500_000.0, 5_400_000.0, 120.0])


def _result(component: tuple[int, ...] = (0, 0, 0)) -> tuple[list[np.ndarray], Result]:
    """Scans of one shape, in map coordinates."""
    shape, v = blob(600, 3), len(component)
    T = np.stack([motion(i, 3, angle=0.9 * i, shift=2.0) for i in range(v)])
    scans = [move(np.linalg.inv(T[i]), shape[i::2]) for i in range(v)]
    T[:, :3, 3] += FAR
    edges = np.array([(0, 1), (0, 2), (1, 2)])
    return scans, Result(
        names=list("abc"),
        T_world_i=T,
        component=np.array(component),
        status=Status.CONVERGED,
        scan_status=np.zeros(v, int),
        num_points=np.array([len(x) for x in scans]),
        num_dropped=np.zeros(v, int),
        edges=edges,
        T_i_j=np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]],
        overlap=np.full(3, 0.8),
        weight=np.ones(3),
        inlier_rmse=np.full(3, 0.01),
    )


def _with_points(
    scans: list[np.ndarray], result: Result, wrong: float
) -> list[dict[str, Any]]:
    """A target that two scans see, and one that is off along x by `wrong`."""
    place = scans[0][0] @ result.T_world_i[0][:3, :3].T + result.T_world_i[0][:3, 3]
    inverse = np.linalg.inv(result.T_world_i[1])
    off = scans[2][5] @ result.T_world_i[2][:3, :3].T + result.T_world_i[2][:3, 3]
    control = [
        (0, np.asarray(scans[0][0], float), place),
        (1, inverse[:3, :3] @ place + inverse[:3, 3], place),
        (2, np.asarray(scans[2][5], float), off + [wrong, 0, 0]),
    ]
    return known_of_scans(KnownOfGraph([], [], control), result, [1.0, 0.9, 0.0])


def test_residuals_are_where_the_pose_puts_the_point_less_the_surveyed():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [10, 0, 0]
    point, surveyed = np.array([1.0, 2, 3]), np.array([8.0, 1, 7])
    entry = control_entry(T, point, surveyed, np.diag([4.0, 4, 9]))
    assert entry["residual"] == [0, 0, -4]
    assert entry["translation"] == 4
    assert entry["normalised_residual"] == pytest.approx(np.sqrt(9 * 16 / 3))
    assert control_entry(T, point, surveyed)["normalised_residual"] is None


def test_a_scan_of_another_component_does_not_lie_in_the_world():
    scans, result = _result((0, 0, 1))
    first, _, last = _with_points(scans, result, 0.0)
    np.testing.assert_allclose(first["residual"], 0, atol=1e-8)
    assert last["residual"] is None
    assert np.isnan(last["translation"])


def test_points_are_numbered_and_keep_all_digits():
    level = {"kind": "level", "frame": "a", "weight": 1.0, "rotation": 0.1}
    scans, result = _result()
    known = _with_points(scans, result, 10.0)
    rows = control_rows([level, *known], result.names)
    assert [(row["number"], row["i"]) for row in rows] == [(1, 0), (2, 1), (3, 2)]
    assert rows[2]["surveyed"] == known[2]["surveyed"]
    assert rows[2]["length"] == pytest.approx(10, abs=1e-8)
    assert control_rows(None, result.names) == []


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with browser() as opened:
        yield opened


def _marks(page: Page) -> list[dict[str, Any]]:
    """The lines of trusted points, those of the others, and the marks, as drawn."""
    return page.run(
        "document.getElementById('scene').data.slice(-3).map(({x, y, z, visible}) =>"
        " ({x, y, z, visible}))"
    )


def _camera(page: Page) -> dict[str, float]:
    return page.run("document.getElementById('scene').layout.scene.camera.eye")


def test_marks_lie_where_the_scans_are_in_map_coordinates(page: Page, tmp_path: Path):
    scans, result = _result()
    for wrong in (0.5, 30.0):
        known = _with_points(scans, result, wrong)
        path = tmp_path / f"{wrong}.html"
        told = dataclasses.replace(result, known=known)
        write_report(path, scans, told, details={"unit": "m"})
        page.open(path)
        good, off, marks = _marks(page)
        assert len(marks["x"]) == 2  # a place that two scans see has one mark
        assert off["x"][0] - off["x"][1] == pytest.approx(wrong, abs=1e-8)
        assert (off["x"][0], off["z"][0]) == (marks["x"][1], marks["z"][1])
        # The point of the scan that was surveyed, in float32 about the same origin.
        drawn = page.run(
            "(({x, y, z}) => [x, y, z].map((c) => Array.from(c)))"
            "(document.getElementById('scene').data[0])"
        )
        gap = np.array([marks[a][0] for a in "xyz"]) - np.array(drawn).T
        assert np.linalg.norm(gap, axis=1).min() < 1e-3
        assert len(good["x"]) == 6
    # What is far off leaves the camera where it is, and lies in the drawing.
    assert "zoom out" in page.run("document.getElementById('hint').textContent")
    far = _camera(page)
    assert page.run("document.getElementById('scene').layout.scene.xaxis.range")[1] > 30
    page.open(tmp_path / "0.5.html")
    assert far == pytest.approx(_camera(page), rel=0.2)
    assert page.errors == []


def test_marks_are_hidden_at_will_and_told_in_a_table(page: Page, tmp_path: Path):
    scans, result = _result()
    known = _with_points(scans, result, 10.0)
    known[2]["name"] = "spire"
    tilts = [("a", 1.0, 0.001), ("c", 0.0, 0.2)]
    known += [
        {"kind": "level", "frame": scan, "weight": weight, "rotation": angle}
        for scan, weight, angle in tilts
    ]
    path = tmp_path / "report.html"
    told = dataclasses.replace(result, known=known)
    write_report(path, scans, told, details={"unit": "m"})
    page.open(path)
    text = page.run("document.getElementById('control').innerText")
    row = text.splitlines()[1].split("\t")
    assert row[:2] == ["spire", "c"]
    x, y, z = known[2]["surveyed"]
    assert [float(s) for s in row[5:8]] == pytest.approx([x, y, z], abs=1e-4)
    assert row[8] == "-10000"  # told in millimetres
    assert row[-1] == "no"
    tiles = page.run("document.getElementById('tiles').textContent")
    assert "2 of 3control points trusted" in tiles
    assert "1 of 2levels trusted" in tiles
    levels = page.run("document.getElementById('priors').innerText").splitlines()[1:]
    assert [line.split("\t")[:2] for line in levels] == [
        ["level 2", "c"],
        ["level 1", "a"],
    ]
    assert levels[0].split("\t")[3] == "11.5"  # degrees
    scene = "document.getElementById('scene').layout.scene"
    labels = f"{scene}.annotations.map(a => a.text)"
    assert page.run(labels) == ["1, 2", "spire"]
    page.click("#none")  # surfaces hide marks
    assert page.run(labels) == ["1, 2", "spire"]
    page.click('[data-marks="off"]')
    assert page.run(labels) == ["1, 2"]
    assert [part["visible"] for part in _marks(page)] == [True, False, True]
    page.click('#when [data-value="before"]')
    assert [part["visible"] for part in _marks(page)] == [False] * 3
    # Poses of map coordinates, with decimals.
    poses = page.run("document.getElementById('poses').innerText")
    assert re.search(r"\t50000\d\.\d{4}", poses)
    assert page.errors == []
    assert page.requests == []


def test_control_points_of_graphs_in_the_plane(page: Page, tmp_path: Path):
    T = np.stack([motion(i, 2, shift=3.0) for i in range(6)])
    edges = np.array([(i, i + 1) for i in range(5)] + [(0, 3), (1, 5)])
    graph = jaxreg.PoseGraph.from_edges(
        edges, np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    )
    sol = jaxreg.average(graph, method=jaxreg.SpanningTree())
    poses = np.asarray(sol.T_world_i)
    places = [poses[k][:2, 2] + [k == 4, 0] for k in range(3, 5)]
    known = [
        {"kind": "control", "frame": 10 * k, "weight": float(k == 3)}
        | control_entry(poses[k], np.zeros(2), place)
        for k, place in zip((3, 4), places, strict=True)
    ]
    path = tmp_path / "report.html"
    write_graph_report(path, graph, sol, names=[10 * k for k in range(6)], known=known)
    page.open(path)
    text = path.read_text("utf-8")
    packed = re.search(r'id="data">(.*?)</script>', text)
    assert packed is not None
    origin = json.loads(gzip.decompress(base64.b64decode(packed[1])))["origin"]
    marks = _marks(page)[-1]
    np.testing.assert_allclose(marks["x"], np.array(places)[:, 0] - origin[0])
    assert "40" in page.run("document.getElementById('control').innerText")
    page.click('[data-marks="trusted"]')
    assert len(_marks(page)[-1]["x"]) == 1
    assert page.errors == []
