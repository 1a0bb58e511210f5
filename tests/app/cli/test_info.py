"""`jaxreg info` on files whose content is known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest

from jaxreg.app.cli.main import main
from tests.helpers import blob


GRID = np.stack(np.meshgrid(*[np.arange(12.0)] * 3), -1).reshape(-1, 3)
GRAPH = """\
VERTEX_SE2 0 0 0 0
EDGE_SE2 0 1 1 0 1.5 1 0 0 1 0 1
EDGE_SE2 1 2 1 0 1.5 1 0 0 1 0 1
LANDMARK 1 2
LANDMARK 3 4
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _json(capsys: pytest.CaptureFixture[str], *files: str) -> dict[str, Any]:
    assert main(["info", *files, "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return json.loads(captured.out)


def test_a_scan_is_measured(capsys: pytest.CaptureFixture[str]):
    points = np.concatenate([2 * GRID, np.full((72, 3), np.nan)])
    np.save("a.npy", points)
    (scan,) = _json(capsys, "a.npy")["files"][0]["scans"]
    assert (scan["num_points"], scan["dim"], scan["dtype"]) == (1800, 3, "float64")
    assert (scan["low"], scan["high"], scan["extent"]) == ([0] * 3, [22] * 3, [22] * 3)
    assert scan["spacing"] == 2
    assert scan["non_finite"] == pytest.approx(0.04)
    assert main(["info", "a.npy"]) == 0
    text = capsys.readouterr().out
    assert "a.npy: 3D scan" in text
    assert "1,800 points, float64" in text
    assert "4.00% of the rows hold NaN or inf" in text


def test_spacing_of_many_points_is_that_of_all(capsys: pytest.CaptureFixture[str]):
    side = 0.25 * np.arange(550)
    flat = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    np.save("a.npy", np.random.default_rng(0).permutation(flat))
    (scan,) = _json(capsys, "a.npy")["files"][0]["scans"]
    assert (scan["num_points"], scan["dim"], scan["spacing"]) == (550**2, 2, 0.25)


def test_of_a_large_scan_some_points_are_looked_at(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("jaxreg.app.describe._MAX_POINTS", 500)
    np.save("a.npy", GRID)
    (scan,) = _json(capsys, "a.npy")["files"][0]["scans"]
    assert (scan["num_points"], scan["step"]) == (1728, 4)
    assert main(["info", "a.npy"]) == 0
    text = capsys.readouterr().out
    assert "about 1,728 points, float64\n  large: one of 4 points was" in text


def test_normals_colours_and_columns_are_named(capsys: pytest.CaptureFixture[str]):
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    vertex = np.zeros(5, dtype=[(n, "u1" if len(n) > 2 else "f4") for n in names])
    plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")]).write("a.ply")
    Path("b.csv").write_text("x;y;z;label\n1,5;2;3;a\n2,5;2;3;b\n")
    ply, csv = (f["scans"][0] for f in _json(capsys, "a.ply", "b.csv")["files"])
    assert ply["fields"] == list(names)
    assert (ply["has_normals"], ply["has_colors"]) == (True, True)
    assert ply["spacing"] is None  # all points coincide
    assert csv["fields"] == ["x", "y", "z", "label"]
    assert (csv["has_normals"], csv["has_colors"]) == (False, False)


def test_archives_folders_and_graphs(capsys: pytest.CaptureFixture[str]):
    Path("sub").mkdir()
    np.savez("sub/both.npz", front=GRID, back=GRID[:, :2])
    Path("sub/g.g2o").write_text(GRAPH)
    Path("sub/t.graph").write_text("EDGE2 3 4 1 0 1.5 1 0 1 1 0 0\n")
    archive, graph, toro = _json(capsys, "sub")["files"]
    assert archive["kind"] == "archive of scans"
    assert [(s["name"], s["dim"]) for s in archive["scans"]] == [
        ("front", 3),
        ("back", 2),
    ]
    assert graph == {
        "file": "sub/g.g2o",
        "kind": "pose graph",
        "num_poses": 3,
        "num_edges": 2,
        "dim": 2,
        "has_initial_poses": False,
        "unknown_lines": {"LANDMARK": 2},
    }
    assert (toro["num_poses"], toro["num_edges"], toro["unknown_lines"]) == (2, 1, {})
    assert main(["info", "sub"]) == 0
    text = capsys.readouterr().out
    assert "2D pose graph\n  3 poses, 2 edges" in text
    assert "unknown lines: 2 x LANDMARK" in text


def test_millimetres_beside_metres_are_noticed(capsys: pytest.CaptureFixture[str]):
    np.save("m.npy", 0.2 * blob(4000, 3))
    np.save("mm.npy", 200 * blob(4000, 3, seed=1))
    found = _json(capsys, "m.npy", "mm.npy")
    assert "m.npy and mm.npy" in found["notes"][0]
    hints = [f["scans"][0]["hint"] for f in found["files"]]
    assert hints[0].startswith("metres")
    assert hints[1].startswith("millimetres")
    assert _json(capsys, "m.npy", "m.npy")["notes"] == []


def test_map_coordinates_in_float32_are_warned_of(
    capsys: pytest.CaptureFixture[str],
):
    far = GRID * 0.1 + [466123.0, 5427001.0, 100.0]
    np.save("far.npy", far)
    np.save("cut.npy", far.astype(np.float32))
    found = _json(capsys, "far.npy", "cut.npy")
    hints = [f["scans"][0]["hint"] for f in found["files"]]
    assert all("map coordinates" in hint for hint in hints)
    assert ["float32 holds steps of 0.5" in hint for hint in hints] == [False, True]
    assert main(["info", "far.npy"]) == 0
    assert "x: 466123.000 to 466124.100, extent 1.1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("none.ply", None, "none.ply: no such file"),
        ("a.doc", b"text", "a.doc: unknown kind of file"),
        ("a.g2o", b"", "a.g2o: no SE2 or SE3 line"),
        ("a.graph", b"EDGE9 1 2\n", "a.graph, line 1"),
        ("a.g2o.gz", b"not packed", "a.g2o.gz: cannot be read"),
    ],
)
def test_a_wrong_file_is_named_and_the_others_are_told(
    capsys: pytest.CaptureFixture[str], name: str, content: bytes | None, said: str
):
    np.save("good.npy", GRID)
    if content is not None:
        Path(name).write_bytes(content)
    assert main(["info", name, "good.npy"]) == 2
    captured = capsys.readouterr()
    assert "good.npy: 3D scan" in captured.out
    assert said in captured.err
    assert len(captured.err.splitlines()) <= 2
    assert main(["info", name, "good.npy", "--json"]) == 2
    files = json.loads(capsys.readouterr().out)["files"]
    assert [f["file"] for f in files] == ["good.npy", name]
    assert said in files[1]["error"]


def test_no_file_at_all(capsys: pytest.CaptureFixture[str]):
    assert main(["info"]) == 2
    assert "No files given" in capsys.readouterr().err
