"""What `jaxreg multiview` writes and tells, with a stand-in for the solver."""

import functools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.app.cli import multiview
from jaxreg.app.cli.main import main
from jaxreg.app.live import LiveView
from jaxreg.io import read_points, read_tum
from tests.app.cli.stand_ins import (
    CLOUD,
    FILES,
    POSES,
    fake_reconstruct,
    save_scans,
    seen_from,
    shift,
    turned,
    write_truth,
)


def test_multiview_writes_all_files_and_tables(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--seed", "7"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == FILES
    for scan in given[0][0]:
        assert scan.dtype == np.float32
        np.testing.assert_allclose(np.median(scan, axis=0), 0, atol=1e-6)
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(found["T_world_i"], POSES, atol=2e-6)
    i, j = 1, 2
    pair = found["pairs"][2]
    assert (pair["i"], pair["j"]) == ("s1", "s2")
    expected = np.linalg.inv(POSES[i]) @ POSES[j]
    np.testing.assert_allclose(pair["T_i_j"], expected, atol=2e-6)
    assert found["command"] == "jaxreg multiview s0.npy s1.npy s2.npy --seed 7"
    made = {"trace", "load", "compile"}
    assert set(found["times_s"]) - made == {"read", "run", "write"}
    merged = read_points("jaxreg-out/merged.ply").reshape(3, 40, 3)
    np.testing.assert_allclose(merged[1:], merged[:2], atol=2e-5)
    text = capsys.readouterr().out
    assert "CONVERGED: 3 of 3 scans placed, 3 of 3 pairs trusted" in text


def test_multiview_far_from_the_origin_keeps_its_digits(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    far = np.array([466123.25, 5427001.5, 100.0])
    for k, T in enumerate(POSES[:2]):
        np.savetxt(folder / f"s{k}.xyz", seen_from(T) + far, fmt="%.9f")
    fake_reconstruct(monkeypatch, POSES, [True] * 2)
    assert main(["multiview", "s0.xyz", "s1.xyz", "--quiet"]) == 0
    merged = read_points("jaxreg-out/merged.ply").reshape(2, 40, 3)
    np.testing.assert_allclose(merged[0], CLOUD + far, rtol=0, atol=1e-6)
    # The turn of 0.4 rad is known to float32, at a lever of some metres.
    np.testing.assert_allclose(merged[1], merged[0], rtol=0, atol=1e-5)
    _, poses = read_tum("jaxreg-out/poses.tum")
    assert poses.shape == (2, 4, 4)


def test_a_view_is_told_of_the_run_and_closed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("viser")
    scans = save_scans(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    opened: list[str] = []
    told: list[str] = []
    monkeypatch.setattr(multiview, "open_where_seen", opened.append)
    for name in ("progress", "poses", "close"):
        monkeypatch.setattr(LiveView, name, _heard(told, getattr(LiveView, name)))
    assert main(["multiview", *scans, "--view", "--json"]) == 0
    assert told == ["progress", "progress", "poses", "close"]
    assert opened[0].startswith("http://localhost:")
    assert json.loads(capsys.readouterr().out)["status"] == "CONVERGED"


def _heard(told: list[str], method: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(method)
    def call(*args: object) -> None:
        told.append(method.__name__)
        method(*args)

    return call


def test_a_viewpoint_is_moved_with_each_scan(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--viewpoint", "0", "-9", "1"]) == 0
    eyes = given[0][2]["viewpoints"]
    for eye, points, file in zip(eyes, given[0][0], scans, strict=True):
        moved = np.load(folder / file)[0] - points[0]
        np.testing.assert_allclose(eye + moved, [0, -9, 1], atol=1e-5)
    assert main(["multiview", *scans, "--viewpoint", "0", "1"]) == 2
    assert "--viewpoint: wanted 3 finite numbers" in capsys.readouterr().err


def test_positions_are_those_of_the_scans_origins(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    fixes = np.array([[4e5, 4.2e6, 100], [4e5 + 3, 4.2e6, 100], [4e5, 4.2e6 + 4, 102]])
    lines = [f"s{k} {x:.2f} {y:.2f} {z:.2f}" for k, (x, y, z) in enumerate(fixes)]
    Path("gnss.txt").write_text("# east north up\n" + "\n".join(lines[::-1]) + "\n")
    run = ["multiview", *scans, "--positions", "gnss.txt", "--deviation", "0.5"]
    assert main([*run, "--upright"]) == 0
    told, method = given[0][2]["positions"], given[0][2]["method"]
    np.testing.assert_allclose(told.position - told.position[0], fixes - fixes[0])
    assert float(told.deviation) == 0.5
    np.testing.assert_array_equal(method.prior.up, [0, 0, 1])
    for origin, points, file in zip(told.antenna, given[0][0], scans, strict=True):
        np.testing.assert_allclose(points[0] - origin, np.load(folder / file)[0], 1e-5)
    Path("gnss.txt").write_text(lines[0])
    assert main(run) == 2
    assert "gnss.txt: has no position of s1, s2" in capsys.readouterr().err
    assert main(["multiview", *scans, "--deviation", "0"]) == 2
    assert "--deviation 0.0: wanted a number above zero" in capsys.readouterr().err


def test_fixed_scans_and_control_points_are_those_of_the_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    poses = turned(0.7, 40.0) @ POSES
    scans = [f"s{k}.npy" for k in range(3)]
    for name, T in zip(scans, poses, strict=True):
        np.save(name, seen_from(T))
    given = fake_reconstruct(monkeypatch, poses, [True] * 3)
    seen = np.load("s2.npy")[:3]
    lies = seen @ poses[2, :3, :3].T + poses[2, :3, 3]
    rows = np.concatenate([seen, lies, np.full((3, 1), 0.01)], axis=1)
    names = ["spire", "7", ""]  # a number is a name where the head says so
    rows = [
        ",".join(["s2", name, *map(repr, row)])
        for name, row in zip(names, rows.tolist(), strict=True)
    ]
    Path("targets.csv").write_text("\n".join(["scan,target,x,y,z,X,Y,Z,sigma", *rows]))
    np.savetxt("pose.txt", poses[1])
    up = poses[0, 2, :3].tolist()
    Path("tilts.csv").write_text(f"scan,x,y,z,sigma\ns0,{up[0]},{up[1]},{up[2]},0.01")
    run = ["multiview", *scans, "--control", "targets.csv", "--level", "tilts.csv"]
    run.append("--fix")
    assert main([*run, "s1=pose.txt"]) == 0
    [(frame, direction, deviation)] = given[0][2]["levels"]
    assert (frame, deviation) == (0, 0.01)
    np.testing.assert_allclose(direction, up)
    (frame, T), told = given[0][2]["fixed"][0], given[0][2]["control"]
    assert (frame, [row[0] for row in told]) == (1, [2, 2, 2])
    # The solver gets scans about their middles, and the same world.
    for k, own, p, q in [(1, T, 0, 0), *((2, poses[2], *row[1:3]) for row in told)]:
        points = np.load(f"s{k}.npy")
        if k == 1:
            centred = given[0][0][1]
            back = centred @ own[:3, :3].T + own[:3, 3]
            wanted = points @ poses[1, :3, :3].T + poses[1, :3, 3]
            np.testing.assert_allclose(back, wanted, atol=1e-5)
        else:
            middle = np.median(points, axis=0)
            moved = own[:3, :3] @ (p + middle) + own[:3, 3]
            np.testing.assert_allclose(moved, q, atol=1e-8)
    np.testing.assert_allclose(told[0][3], np.eye(3) * 1e4)
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(found["T_world_i"], poses, rtol=0, atol=1e-4)
    assert found["fixed"] == ["s1"]
    np.testing.assert_allclose(found["scans"][2]["covariance"], 1e-6 * np.eye(6))
    assert [row["frame"] for row in found["known"]] == ["s2"] * 3 + ["s0"]
    assert [row.get("name") for row in found["known"]] == ["spire", "7", None, None]
    point = found["known"][1]
    np.testing.assert_allclose(point["point"], seen[1])
    np.testing.assert_allclose(point["surveyed"], lies[1])
    assert point["translation"] == pytest.approx(np.linalg.norm(point["residual"]))
    assert point["normalised_residual"] < 1e-3 / 0.01
    assert found["known"][3]["kind"] == "level"
    assert found["known"][3]["rotation"] < 1e-4
    printed = capsys.readouterr().out
    assert "Priors, control points and levels" in printed
    assert "spire" in printed
    assert main([*run, "s7=pose.txt"]) == 2
    assert "--fix s7=pose.txt: no 's7'; the first are s0" in capsys.readouterr().err


def test_truth_adds_errors(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    wrong = POSES.copy()
    wrong[2] = wrong[2] @ turned(0.01, 0.0) @ shift(np.array([0.0, -1.0, -2.0]))
    fake_reconstruct(monkeypatch, wrong, [True] * 3)
    write_truth(folder, scans, POSES)
    assert main(["multiview", *scans, "--truth", "truth.conf"]) == 0
    errors = json.loads(Path("jaxreg-out/result.json").read_text())["errors"]
    assert errors["names"] == ["s0", "s1", "s2"]
    np.testing.assert_allclose(errors["e_R"], [0, 0, 0.01], atol=1e-5)
    assert errors["mean_e_R"] == pytest.approx(0.01 / 3, abs=1e-5)
    assert "e_R [rad]" in capsys.readouterr().out


def test_a_lost_scan_is_reported_and_the_others_are_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    fake_reconstruct(monkeypatch, POSES, [True, True, False])
    assert main(["multiview", *scans, "--out", "deep/er"]) == 0
    text = capsys.readouterr().out
    assert "LOW_OVERLAP, not placed" in text
    assert "2 of 3 scans placed" in text
    found = json.loads(Path("deep/er/result.json").read_text())
    assert found["T_world_i"][2] is None
    assert found["scans"][2]["best_pair"]["overlap"] == pytest.approx(0.1)
    assert len(read_points("deep/er/merged.ply")) == 80


def test_a_second_object_is_a_model_of_its_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder) + ["t0.npy", "t1.npy"]
    shutil.copy("s0.npy", "t0.npy")
    shutil.copy("s1.npy", "t1.npy")
    poses = POSES[[0, 1, 2, 0, 1]]
    fake_reconstruct(monkeypatch, poses, [True] * 3 + [False] * 2, [0, 0, 0, 1, 1])
    assert main(["multiview", *scans]) == 0
    text = capsys.readouterr().out
    assert "component 1" in text
    assert "Component 1: 2 scans that fit each other" in text
    assert "merged_1.ply" in text
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert [scan["component"] for scan in found["scans"]] == [0, 0, 0, 1, 1]
    own = read_points("jaxreg-out/merged_1.ply")
    # In the frame of t0.npy, the first scan of its component.
    np.testing.assert_allclose(own[:40], seen_from(POSES[0]), atol=1e-5)
    np.testing.assert_allclose(own[40:], own[:40], atol=1e-5)
    # A later run with one component leaves nothing of the other behind.
    (folder / "jaxreg-out" / "merged_2.ply").write_text("mine")
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans[:3]]) == 0
    assert sorted(os.listdir("jaxreg-out")) == sorted([*FILES, "merged_2.ply"])


def test_errors_of_a_second_object_are_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = [*save_scans(folder), "t0.npy", "t1.npy"]
    shutil.copy("s0.npy", "t0.npy")
    shutil.copy("s1.npy", "t1.npy")
    found = POSES[[0, 1, 2, 0, 1]]
    found[4] = found[4] @ turned(0.01, 0.0)
    fake_reconstruct(monkeypatch, found, [True] * 3 + [False] * 2, [0, 0, 0, 1, 1])
    write_truth(folder, scans, POSES[[0, 1, 2, 0, 1]])
    assert main(["multiview", *scans, "--truth", "truth.conf"]) == 0
    errors = json.loads(Path("jaxreg-out/result.json").read_text())["errors"]
    assert errors["component"] == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(errors["e_R"], [0, 0, 0, 0, 0.01], atol=1e-5)
    assert "t1, component 1" in capsys.readouterr().out


def test_scans_without_overlap_are_named_and_can_be_looked_at(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)[:2]
    fake_reconstruct(monkeypatch, POSES, [True, False])
    assert main(["multiview", *scans]) == 3
    message = capsys.readouterr().err
    assert "s0.npy and s1.npy: no two scans could be joined" in message
    assert len(message.splitlines()) == 3
    found = sorted(os.listdir("jaxreg-out"))
    assert found == ["figure.png", "report.html", "result.json"]
    page = Path("jaxreg-out/report.html").read_text()
    assert "Best attempt, not believed: 2 scans in one frame" in page


def test_dropped_rows_are_counted(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    holed = seen_from(POSES[1])
    holed = np.concatenate([holed, [[np.nan, 0, 0], [np.inf, 0, 0]]])
    np.save(folder / "s1.npy", holed)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert [s["num_dropped"] for s in found["scans"]] == [0, 2, 0]
    assert [s["num_points"] for s in found["scans"]] == [40, 42, 40]
    assert len(read_points("jaxreg-out/merged.ply")) == 120


def test_large_scans_are_thinned_and_it_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    np.save(folder / "s1.npy", np.repeat(seen_from(POSES[1]), 3, axis=0))
    monkeypatch.setattr("jaxreg.app.cli.inputs._MAX_POINTS", 50)
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    said = capsys.readouterr().out
    assert "s1.npy: large, one of 3 points is used, 40 in all." in said
    assert [len(scan) for scan in given[0][0]] == [40, 40, 40]


def test_budget_and_precision_reach_the_search(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scans = save_scans(folder)
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    options = ["--budget", "100", "--precision", "float64", "--device", "cpu"]
    assert main(["multiview", *scans, *options]) == 0
    found, _, settings = given[0]
    assert all(scan.dtype == np.float64 for scan in found)
    method = settings["method"]
    assert (method.num_prior, method.num_particles) == (100, 100)
    assert jnp.zeros(()).dtype == jnp.float32  # the setting ends with the command
    told = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(told["T_world_i"], POSES, atol=1e-12)


def test_names_that_are_no_utf_8(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = [os.fsdecode(b"scan\xff%d.npy" % k) for k in range(3)]
    for old, new in zip(save_scans(folder), scans, strict=True):
        os.rename(old, new)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    assert sorted(os.listdir("jaxreg-out")) == FILES
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert found["names"] == [rf"scan\xff{k}" for k in range(3)]
    assert main(["info", *scans]) == 0
    assert r"scan\udcff0.npy: 3D scan" in capsys.readouterr().out


def test_a_readme_and_a_damaged_log_are_said_and_the_run_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (folder / "scans").mkdir()
    save_scans(folder / "scans")
    (folder / "scans" / "readme.txt").write_text("not a point in here\n")
    (folder / "jaxreg-out").mkdir()
    (folder / "jaxreg-out" / "pairs.jsonl").write_bytes(bytes(range(256)) * 4)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", "scans", "--resume"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "readme.txt: holds no points, skipped." in said
    assert "pairs.jsonl: damaged from its first line on, all pairs are new." in said
    assert sorted(os.listdir("jaxreg-out")) == FILES
