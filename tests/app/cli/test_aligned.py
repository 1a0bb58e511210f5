"""Whole scans in the common frame: `--save-aligned`, `--color`, and `jaxreg apply`."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest

import jaxreg
from jaxreg.app.cli.main import main
from jaxreg.io import read_points, write_kitti, write_points, write_tum
from tests.app.cli.stand_ins import CLOUD, POSES, fake_reconstruct, seen_from


RNG = np.random.default_rng(1)
COLORS = RNG.integers(0, 256, (40, 3)).astype(np.uint8)
NORMALS = RNG.normal(size=(40, 3)).astype(np.float32)


def _save(folder: Path, suffix: str = ".ply") -> list[str]:
    """Scans with colours, normals that are the same in the world, and intensity."""
    names = [f"s{k}{suffix}" for k in range(3)]
    for name, T in zip(names, POSES, strict=True):
        write_points(
            folder / name,
            seen_from(T),
            colors=COLORS,
            normals=NORMALS @ T[:3, :3],
            intensity=np.arange(40),
        )
    return names


@pytest.mark.parametrize("suffix", [".ply", ".csv", ".pcd", ".las"])
def test_scans_are_saved_whole_in_the_common_frame(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    suffix: str,
):
    scans = _save(folder, suffix)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--save-aligned"]) == 0
    assert "aligned/ (3 files)" in " ".join(capsys.readouterr().out.split())
    for name in scans:
        found = read_points(folder / "jaxreg-out" / "aligned" / name)
        np.testing.assert_allclose(found, CLOUD, atol=2e-5)
    files = json.loads(Path("jaxreg-out/result.json").read_text())["files"]
    assert files[-3:] == [f"aligned/{name}" for name in scans]
    # Another run without the option leaves none of an older result.
    assert main(["multiview", *scans]) == 0
    assert os.listdir("jaxreg-out/aligned") == []


@pytest.mark.parametrize("how", ["rewritten", "removed"])
def test_a_scan_that_changes_meanwhile_is_left_out_and_named(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    how: str,
):
    scans = _save(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    solve = jaxreg.reconstruct

    def meanwhile(*args: Any, **told: Any) -> Any:
        Path(scans[1]).unlink()
        if how == "rewritten":
            write_points(scans[1], 2 * CLOUD[:30])
        return solve(*args, **told)

    monkeypatch.setattr(jaxreg, "reconstruct", meanwhile)
    assert main(["multiview", *scans, "--save-aligned", "--color", "own"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "s1: has changed since it was read, not aligned" in said
    assert sorted(os.listdir("jaxreg-out/aligned")) == ["s0.ply", "s2.ply"]
    files = json.loads(Path("jaxreg-out/result.json").read_text())["files"]
    assert "aligned/s1.ply" not in files
    # What was read is in the model, without colours of its own.
    vertex = plyfile.PlyData.read("jaxreg-out/merged.ply")["vertex"]
    assert len(vertex["red"]) == 120
    np.testing.assert_array_equal(vertex["red"][:40], COLORS[:, 0])


def test_scans_are_not_replaced_by_what_is_made_of_them(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    [name] = _save(folder)[:1]
    np.savetxt("T.txt", POSES[1])
    before = Path(name).read_bytes()
    assert main(["apply", "T.txt", name, "--out", "."]) == 2
    assert f"{name}: is a scan that is read" in capsys.readouterr().err
    assert Path(name).read_bytes() == before


def test_scans_of_other_models_are_in_folders_of_their_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scans = _save(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3, component=[0, 0, 1])
    assert main(["multiview", *scans, "--save-aligned", "--quiet"]) == 0
    assert sorted(os.listdir("jaxreg-out/aligned")) == ["s0.ply", "s1.ply"]
    assert os.listdir("jaxreg-out/aligned_1") == ["s2.ply"]


@pytest.mark.parametrize("suffix", [".ply", ".csv", ".pcd", ".las"])
@pytest.mark.parametrize("color", ["scan", "own"])
def test_the_merged_model_has_normals_and_the_scans_own_colours(
    folder: Path, monkeypatch: pytest.MonkeyPatch, color: str, suffix: str
):
    scans = _save(folder, suffix)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--color", color, "--quiet"]) == 0
    vertex = plyfile.PlyData.read("jaxreg-out/merged.ply")["vertex"]
    found = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(found.shape, (120, 3))
    if color == "own":
        np.testing.assert_array_equal(found, np.tile(COLORS, (3, 1)))
    else:
        assert len(np.unique(found, axis=0)) == 3
    normals = np.stack([vertex[c] for c in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(normals, np.tile(NORMALS, (3, 1)), atol=1e-5)


def test_a_voxel_keeps_one_point_a_cube(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--voxel", "1.5", "--color", "own"]) == 0
    found = read_points("jaxreg-out/merged.ply")
    cells = np.floor((CLOUD - CLOUD.min(axis=0)) / 1.5)
    assert abs(len(found) - len(np.unique(cells, axis=0))) <= 3
    assert main(["multiview", *scans, "--voxel", "0"]) == 2
    assert "--voxel 0.0: wanted a number above zero" in capsys.readouterr().err


def _write_poses(kind: str) -> str:
    path = f"poses.{kind}"
    if kind == "json":
        document = {"names": ["s1", "s2", "s0"], "T_world_i": POSES[[1, 2, 0]].tolist()}
        Path(path).write_text(json.dumps(document))
    elif kind == "tum":
        write_tum(path, POSES)
    elif kind == "txt":
        write_kitti(path, POSES)
    elif kind == "npy":
        np.save(path, POSES)
    elif kind == "conf":
        lines = []
        for k, T in enumerate(POSES):
            half = 0.5 * np.arctan2(T[1, 0], T[0, 0])
            numbers = [*T[:3, 3], 0, 0, -np.sin(half), np.cos(half)]
            lines.append(f"bmesh s{k}.ply " + " ".join(map(repr, map(float, numbers))))
        Path(path).write_text("\n".join(lines))
    elif kind == "log":
        blocks = [
            f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(repr, r)) for r in T.tolist())
            for k, T in enumerate(POSES)
        ]
        Path(path).write_text("\n".join(blocks))
    return path


@pytest.mark.parametrize("kind", ["json", "tum", "txt", "npy", "conf", "log"])
def test_poses_of_every_kind_move_the_scans(
    folder: Path, capsys: pytest.CaptureFixture[str], kind: str
):
    scans = _save(folder)
    assert main(["apply", _write_poses(kind), *scans, "--out", "moved"]) == 0
    assert "Written to moved: s0.ply, s1.ply, s2.ply." in capsys.readouterr().out
    for name in scans:
        # Digits of maps are kept whatever JAX computes in.
        np.testing.assert_allclose(read_points(f"moved/{name}"), CLOUD, atol=1e-12)
    assert main(["apply", _write_poses(kind), "moved", "--inverse", "--quiet"]) == 0
    found = read_points("jaxreg-aligned/s2.ply")
    np.testing.assert_allclose(found, seen_from(POSES[2]), atol=1e-12)


def test_scans_of_an_archive_are_moved_by_name(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    np.savez("all.npz", s0=seen_from(POSES[0]), s2=seen_from(POSES[2]), other=CLOUD)
    assert main(["apply", _write_poses("json"), "all.npz"]) == 0
    assert "other: has no pose, left out" in capsys.readouterr().out
    found = np.load("jaxreg-aligned/all.npz")
    assert sorted(found) == ["s0", "s2"]
    np.testing.assert_allclose(found["s2"], CLOUD)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["poses.json", "x.ply"], "x.ply: no such file"),
        (["poses.json"], "No scans given"),
        (["poses.json", "a.npy"], "holds poses of s1, s2, s0, ... but the scans are a"),
        (["poses.txt", "a.npy"], "holds 3 poses without names, but there are 1 scans"),
        (["a.npy", "a.npy"], "wanted poses"),
        (["pairs.log", "a.npy"], "holds motions of pairs, not poses"),
    ],
)
def test_poses_that_do_not_fit_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
):
    np.save("a.npy", CLOUD)
    for kind in ("json", "txt"):
        _write_poses(kind)
    rows = "\n".join(" ".join(map(str, row)) for row in np.eye(4).tolist())
    Path("pairs.log").write_text(f"0 1 2\n{rows}\n")
    assert main(["apply", *arguments]) == 2
    message = capsys.readouterr().err
    assert told in message
    assert len(message.splitlines()) <= 2
    assert not Path("jaxreg-aligned").exists()
