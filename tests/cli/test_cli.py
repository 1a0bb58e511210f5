"""Commands with stand-ins for the solvers, so that each test takes milliseconds."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg
from jaxreg import Status
from jaxreg.cli.main import main
from jaxreg.io import MissingExtraError, read_points, read_tum, write_ply
from jaxreg.local import Modes


RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(40, 3))
FILES = [
    "figure.png",
    "graph.g2o",
    "merged.ply",
    "poses.tum",
    "report.html",
    "result.json",
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, and solvers that must not be reached."""
    monkeypatch.chdir(tmp_path)

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("bad input reached the computation")

    monkeypatch.setattr(jaxreg, "reconstruct", never)
    monkeypatch.setattr(jaxreg, "register", never)
    return tmp_path


def _fake_reconstruct(
    monkeypatch: pytest.MonkeyPatch,
    T_true: np.ndarray,
    placed: list[bool],
    component: list[int] | None = None,
) -> list[Any]:
    """A solver that knows the poses of the centred scans; returns what it was given."""
    given: list[Any] = []

    def reconstruct(
        scans: list[np.ndarray], *, key: Any, progress: Any, **options: Any
    ) -> Any:
        given.append((scans, key, options))
        progress("pairs", 1, 3)
        progress("pairs", 3, 3)
        v = len(scans)
        middles = [np.median(CLOUD, axis=0)] * v
        T = np.stack([_shift(-middles[0]) @ T_true[i] for i in range(v)])
        T = np.stack([T[i] @ _shift(_middle_of(T_true[i])) for i in range(v)])
        edges = np.array([(i, j) for i in range(v) for j in range(i + 1, v)])
        i, j = edges.T
        graph = jaxreg.PoseGraph.from_edges(edges, np.linalg.inv(T)[i] @ T[j])
        both = np.array(placed)[edges].all(axis=1)
        lost, overlap = Status.LOW_OVERLAP, jnp.asarray(np.where(both, 0.8, 0.1))
        zeros = jnp.zeros(len(edges))
        dropped = [np.sum(~np.isfinite(s).all(1)) for s in scans]
        modes = (x[:, None] for x in (graph.T_i_j, overlap, zeros))
        return jaxreg.ReconstructionSolution(
            T_world_i=jnp.asarray(T),
            status=jnp.asarray(0 if all(placed) else Status.DISCONNECTED, int),
            scan_status=jnp.asarray([0 if p else lost for p in placed]),
            placed=jnp.asarray(placed),
            component=jnp.asarray(component or np.where(placed, 0, -1)),
            graph=graph,
            overlap=overlap,
            edge_weight=jnp.asarray(both.astype(float)),
            inlier_rmse=zeros,
            mode=jnp.zeros(len(edges), int),
            motions=jaxreg.RelativeMotions(graph.edges, *modes),
            num_dropped=jnp.asarray(dropped),
        )

    monkeypatch.setattr(jaxreg, "reconstruct", reconstruct)
    return given


def _shift(t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = t
    return T


def _middle_of(T_world_scan: np.ndarray) -> np.ndarray:
    return np.median(_seen_from(T_world_scan), axis=0)


def _seen_from(T_world_scan: np.ndarray) -> np.ndarray:
    T = np.linalg.inv(T_world_scan)
    return CLOUD @ T[:3, :3].T + T[:3, 3]


def _turned(angle: float, offset: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], [offset, 1, 2]
    return T


POSES = np.stack([np.eye(4), _turned(0.4, 3.0), _turned(-1.2, -5.0)])


def _save_scans(folder: Path) -> list[str]:
    for k, T in enumerate(POSES):
        np.save(folder / f"s{k}.npy", _seen_from(T))
    return [f"s{k}.npy" for k in range(3)]


def _left(folder: Path) -> set[str]:
    return set(os.listdir(folder))


def test_multiview_writes_all_files_and_tables(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    given = _fake_reconstruct(monkeypatch, POSES, [True] * 3)
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
    assert set(found["times_s"]) == {"read", "compile", "run", "write"}
    merged = read_points("jaxreg-out/merged.ply").reshape(3, 40, 3)
    np.testing.assert_allclose(merged[1:], merged[:2], atol=2e-5)
    text = capsys.readouterr().out
    assert "CONVERGED: 3 of 3 scans placed, 3 of 3 pairs trusted" in text


def test_multiview_far_from_the_origin_keeps_its_digits(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    far = np.array([466123.25, 5427001.5, 100.0])
    for k, T in enumerate(POSES[:2]):
        np.savetxt(folder / f"s{k}.xyz", _seen_from(T) + far, fmt="%.9f")
    _fake_reconstruct(monkeypatch, POSES, [True] * 2)
    assert main(["multiview", "s0.xyz", "s1.xyz", "--quiet"]) == 0
    merged = read_points("jaxreg-out/merged.ply").reshape(2, 40, 3)
    np.testing.assert_allclose(merged[0], CLOUD + far, rtol=0, atol=1e-6)
    # The turn of 0.4 rad is known to float32, at a lever of some metres.
    np.testing.assert_allclose(merged[1], merged[0], rtol=0, atol=1e-5)
    _, poses = read_tum("jaxreg-out/poses.tum")
    assert poses.shape == (2, 4, 4)


def test_a_viewpoint_is_moved_with_each_scan(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    given = _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--viewpoint", "0", "-9", "1"]) == 0
    eyes = given[0][2]["viewpoints"]
    for eye, points, file in zip(eyes, given[0][0], scans, strict=True):
        moved = np.load(folder / file)[0] - points[0]
        np.testing.assert_allclose(eye + moved, [0, -9, 1], atol=1e-5)
    assert main(["multiview", *scans, "--viewpoint", "0", "1"]) == 2
    assert "--viewpoint: wanted 3 finite numbers" in capsys.readouterr().err


def _write_truth(folder: Path, scans: list[str], poses: np.ndarray) -> None:
    lines = []
    for name, T in zip(scans, poses, strict=True):
        half = 0.5 * np.arctan2(T[1, 0], T[0, 0])
        t = " ".join(map(str, T[:3, 3]))
        lines.append(f"bmesh {name} {t} 0 0 {-np.sin(half)} {np.cos(half)}")
    (folder / "truth.conf").write_text("\n".join(lines).replace(".npy", ".ply"))


def test_truth_adds_errors(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    wrong = POSES.copy()
    wrong[2] = wrong[2] @ _turned(0.01, 0.0) @ _shift(np.array([0.0, -1.0, -2.0]))
    _fake_reconstruct(monkeypatch, wrong, [True] * 3)
    _write_truth(folder, scans, POSES)
    assert main(["multiview", *scans, "--truth", "truth.conf"]) == 0
    errors = json.loads(Path("jaxreg-out/result.json").read_text())["errors"]
    assert errors["names"] == ["s0", "s1", "s2"]
    np.testing.assert_allclose(errors["e_R"], [0, 0, 0.01], atol=1e-5)
    assert errors["mean_e_R"] == pytest.approx(0.01 / 3, abs=1e-5)
    assert "e_R [rad]" in capsys.readouterr().out


def test_a_lost_scan_is_reported_and_the_others_are_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    _fake_reconstruct(monkeypatch, POSES, [True, True, False])
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
    scans = _save_scans(folder) + ["t0.npy", "t1.npy"]
    shutil.copy("s0.npy", "t0.npy")
    shutil.copy("s1.npy", "t1.npy")
    poses = POSES[[0, 1, 2, 0, 1]]
    _fake_reconstruct(monkeypatch, poses, [True] * 3 + [False] * 2, [0, 0, 0, 1, 1])
    assert main(["multiview", *scans]) == 0
    text = capsys.readouterr().out
    assert "component 1" in text
    assert "Component 1: 2 scans that fit each other" in text
    assert "merged_1.ply" in text
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert [scan["component"] for scan in found["scans"]] == [0, 0, 0, 1, 1]
    own = read_points("jaxreg-out/merged_1.ply")
    # In the frame of t0.npy, the first scan of its component.
    np.testing.assert_allclose(own[:40], _seen_from(POSES[0]), atol=1e-5)
    np.testing.assert_allclose(own[40:], own[:40], atol=1e-5)
    # A later run with one component leaves nothing of the other behind.
    (folder / "jaxreg-out" / "merged_2.ply").write_text("mine")
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans[:3]]) == 0
    assert sorted(os.listdir("jaxreg-out")) == sorted([*FILES, "merged_2.ply"])


def test_errors_of_a_second_object_are_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = [*_save_scans(folder), "t0.npy", "t1.npy"]
    shutil.copy("s0.npy", "t0.npy")
    shutil.copy("s1.npy", "t1.npy")
    found = POSES[[0, 1, 2, 0, 1]]
    found[4] = found[4] @ _turned(0.01, 0.0)
    _fake_reconstruct(monkeypatch, found, [True] * 3 + [False] * 2, [0, 0, 0, 1, 1])
    _write_truth(folder, scans, POSES[[0, 1, 2, 0, 1]])
    assert main(["multiview", *scans, "--truth", "truth.conf"]) == 0
    errors = json.loads(Path("jaxreg-out/result.json").read_text())["errors"]
    assert errors["component"] == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(errors["e_R"], [0, 0, 0, 0, 0.01], atol=1e-5)
    assert "t1, component 1" in capsys.readouterr().out


def test_scans_without_overlap_are_named_and_nothing_is_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)[:2]
    _fake_reconstruct(monkeypatch, POSES, [True, False])
    before = _left(folder)
    assert main(["multiview", *scans]) == 2
    message = capsys.readouterr().err
    assert "s0.npy and s1.npy: no two scans could be joined" in message
    assert len(message.splitlines()) == 2
    assert _left(folder) == before


def test_dropped_rows_are_counted(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    holed = _seen_from(POSES[1])
    holed = np.concatenate([holed, [[np.nan, 0, 0], [np.inf, 0, 0]]])
    np.save(folder / "s1.npy", holed)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert [s["num_dropped"] for s in found["scans"]] == [0, 2, 0]
    assert [s["num_points"] for s in found["scans"]] == [40, 42, 40]
    assert len(read_points("jaxreg-out/merged.ply")) == 120


def _registered(T: np.ndarray, status: int, overlap: float) -> Any:
    """A solution with the pose that the search ended in, and an unused mode."""
    number, modes = jnp.zeros((), int), jnp.asarray([1.0, 0.0])
    covariance = 1e-6 * jnp.eye(6)
    return jaxreg.RegistrationSolution(
        T_target_source=jnp.asarray(T),
        status=jnp.asarray(status, int),
        fitness=jnp.asarray(0.95),
        inlier_rmse=jnp.asarray(0.02),
        num_inliers=number,
        overlap=jnp.asarray(overlap),
        num_steps=number,
        H=jnp.eye(6),
        b=jnp.zeros(6),
        error=jnp.zeros(()),
        covariance=covariance,
        modes=Modes(
            T_target_source=jnp.stack([T, T]),
            weight=modes,
            fitness=0.95 * modes,
            overlap=overlap * modes,
            inlier_rmse=0.02 * modes,
            covariance=jnp.stack([covariance] * 2),
        ),
    )


def _register_s1_onto_s0(
    source: np.ndarray, target: np.ndarray, method: Any, *, key: Any
) -> Any:
    assert np.isfinite(source).all()
    T = _shift(-np.median(CLOUD, axis=0)) @ POSES[1] @ _shift(_middle_of(POSES[1]))
    return _registered(T, 0, 0.93)


def test_register_writes_the_motion_between_the_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    _save_scans(folder)

    monkeypatch.setattr(jaxreg, "register", _register_s1_onto_s0)
    assert main(["register", "s1.npy", "s0.npy"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == FILES
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert found["names"] == ["s0", "s1"]
    np.testing.assert_allclose(found["T_world_i"][1], POSES[1], atol=2e-6)
    assert "overlap 0.930" in capsys.readouterr().out


@pytest.mark.parametrize("status", [Status.LOW_OVERLAP, Status.NON_FINITE])
def test_register_without_overlap_exits_with_2(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    status: Status,
):
    _save_scans(folder)

    def register(source: np.ndarray, target: np.ndarray, method: Any, **_: Any) -> Any:
        return _registered(np.full((4, 4), np.nan), status, 0.0)

    monkeypatch.setattr(jaxreg, "register", register)
    before = _left(folder)
    assert main(["register", "s1.npy", "s0.npy"]) == 2
    message = capsys.readouterr().err
    assert f"s1.npy onto s0.npy: {status.name}" in message
    assert len(message.splitlines()) == 2
    assert _left(folder) == before


def _bad_inputs(folder: Path) -> dict[str, tuple[list[str], str]]:
    """Command lines that must fail, and what their message must name."""
    _save_scans(folder)
    (folder / "empty.xyz").write_text("")
    (folder / "broken.ply").write_text("ply\nnothing more\n")
    (folder / "occupied").write_text("a file")
    write_ply(folder / "scan.ply", CLOUD)
    np.save(folder / "few.npy", np.repeat(CLOUD[:3], 9, axis=0))
    np.save(folder / "nan.npy", np.where(np.arange(40)[:, None] < 3, CLOUD, np.nan))
    np.save(folder / "flat.npy", CLOUD[:, :2])
    np.save(folder / "mm.npy", 1000 * CLOUD)
    np.savez(folder / "one.npz", alone=CLOUD)
    np.savez(folder / "three.npz", a=CLOUD, b=CLOUD, c=CLOUD)
    (folder / "hollow").mkdir()
    (folder / "bad.g2o").write_text("EDGE_SE3:QUAT 0 1 1 2 3\n")
    (folder / "other.conf").write_text("bmesh chin.ply 0 0 0 0 0 0 1\n")
    m, r, a = "multiview", "register", "average"
    pair = ["s0.npy", "s1.npy"]
    return {
        "missing": ([m, "s0.npy", "none.ply"], "none.ply"),
        "empty": ([m, "s0.npy", "empty.xyz"], "empty.xyz"),
        "unreadable": ([m, "s0.npy", "broken.ply"], "broken.ply"),
        "too few": ([m, "s0.npy", "few.npy"], "few.npy: holds 3 distinct"),
        "all but three NaN": ([m, "s0.npy", "nan.npy"], "nan.npy: holds 3 distinct"),
        "mixed": ([m, "s0.npy", "flat.npy"], "flat.npy: is 2D, but s0.npy is 3D"),
        "other unit": ([m, *pair, "mm.npy"], "mm.npy: spans"),
        "one file": ([m, "s0.npy"], "s0.npy: this is one scan alone"),
        "one in archive": ([m, "one.npz"], "one.npz: this is one scan alone"),
        "no scan": ([m], "No scans given"),
        "empty folder": ([m, "hollow"], "hollow: the folder holds no point files"),
        "out is a file": ([m, *pair, "--out", "occupied"], "occupied"),
        "out below a file": ([r, *pair, "--out", "occupied/x"], "occupied"),
        "demo out": (["demo", "--out", "occupied"], "occupied"),
        "no budget": ([m, *pair, "--budget", "3"], "--budget 3: wanted a number"),
        "no steps": ([a, "g.g2o", "--budget", "0"], "--budget 0: wanted at least 1"),
        "no such device": (["demo", "--device", "tpu"], "--device tpu: JAX finds none"),
        "bad seed": ([m, *pair, "--seed", "-1"], "--seed -1"),
        "truth missing": ([m, *pair, "--truth", "none.conf"], "none.conf"),
        "truth of others": ([m, *pair, "--truth", "other.conf"], "other.conf"),
        "register missing": ([r, "s0.npy", "none.ply"], "none.ply"),
        "register many": ([r, "three.npz", "s0.npy"], "three.npz"),
        "graph missing": ([a, "none.g2o"], "none.g2o"),
        "graph of scans": ([a, "scan.ply"], "scan.ply: not a text file.\nGive"),
        "graph cut off": ([a, "bad.g2o"], "bad.g2o, line 1"),
    }


@pytest.mark.parametrize("kind", range(25))
def test_bad_input_is_named_in_two_lines_with_exit_code_2(
    folder: Path, capsys: pytest.CaptureFixture[str], kind: int
):
    arguments, named = list(_bad_inputs(folder).values())[kind]
    before = _left(folder)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert len(captured.err.splitlines()) <= 2
    assert captured.out == ""
    assert _left(folder) == before


def test_a_failure_while_writing_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scans = _save_scans(folder)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jaxreg.io.result.write_g2o", full)
    before = _left(folder)
    assert main(["multiview", *scans]) == 2
    assert _left(folder) == before


def test_interruption_is_said_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxreg, "reconstruct", stopped)
    assert main(["multiview", *scans]) == 130
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_an_interruption_that_python_dropped_is_heard_again():
    code = """
import gc, sys, time
from jaxreg.cli import main

def drop(*_):
    gc.callbacks.clear()
    raise KeyboardInterrupt

def run(_):
    gc.callbacks.append(drop)
    gc.collect()
    time.sleep(30)

main._run, sys.argv = run, ["jaxreg", "info"]
main.command()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "jaxreg: interrupted; no results were written.\n"


def test_a_reader_who_leaves_is_no_error():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        command = [sys.executable, "-m", "jaxreg", "--help"]
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (141, b"")


def test_an_interrupted_run_keeps_its_pairs_and_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    found = jaxreg.RelativeMotions(
        jnp.array([[0, 1]]),
        jnp.eye(4)[None, None],
        jnp.array([[0.7]]),
        jnp.array([[0.01]]),
    )

    def stopped(*_: Any, on_pairs: Any, **__: Any) -> None:
        on_pairs(found)
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxreg, "reconstruct", stopped)
    assert main(["multiview", *scans]) == 130
    message = capsys.readouterr().err
    assert "pairs.jsonl: 1;" in message
    assert "--resume" in message
    kept = folder / "jaxreg-out" / "pairs.jsonl"
    assert kept.exists()
    # Pairs of another run are not taken for those of this one, nor lost.
    assert main(["multiview", *scans, "--resume", "--seed", "1"]) == 2
    assert "another seed" in capsys.readouterr().err
    assert kept.exists()
    given = _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--resume", "--order", "sequential"]) == 0
    options = given[0][2]
    assert options["order"] == "sequential"
    for one, other in zip(
        jax.tree.leaves(options["previous"]), jax.tree.leaves(found), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert not kept.exists()


def test_a_missing_extra_is_said_in_two_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(
        "jaxreg.cli.main.find_spec", lambda name: None if name == "rich" else name
    )
    assert main(["demo"]) == 2
    message = capsys.readouterr().err
    assert "rich" in message
    assert "pip install 'jaxreg[app]'" in message


def test_budget_and_precision_reach_the_search(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scans = _save_scans(folder)
    given = _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    options = ["--budget", "100", "--precision", "float64", "--device", "cpu"]
    assert main(["multiview", *scans, *options]) == 0
    found, _, settings = given[0]
    assert all(scan.dtype == np.float64 for scan in found)
    method = settings["method"]
    assert (method.num_prior, method.num_particles) == (100, 100)
    assert jnp.zeros(()).dtype == jnp.float32  # the setting ends with the command
    told = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(told["T_world_i"], POSES, atol=1e-12)


@pytest.mark.parametrize(
    "command", ["demo", "register", "multiview", "average", "info"]
)
def test_help_tells_the_default_of_every_option(
    capsys: pytest.CaptureFixture[str], command: str
):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    options = re.findall(r" (--[a-z]+)(?= )(?:(?! --[a-z]).)*", text.split("exit")[1])
    assert "--json" in options
    assert len(options) == text.split("exit")[1].count("(default: ")


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 0
    assert "multiview" in capsys.readouterr().out


def test_large_scans_are_thinned_and_it_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    np.save(folder / "s1.npy", np.repeat(_seen_from(POSES[1]), 3, axis=0))
    monkeypatch.setattr("jaxreg.cli.inputs._MAX_POINTS", 50)
    given = _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    said = capsys.readouterr().out
    assert "s1.npy: large, one of 3 points is used, 40 in all." in said
    assert [len(scan) for scan in given[0][0]] == [40, 40, 40]


def test_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("jaxreg ")


def test_quiet_prints_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--quiet"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


@pytest.mark.parametrize("command", ["multiview", "register", "average", "demo"])
def test_json_is_all_that_goes_to_standard_output(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
):
    scans = _save_scans(folder)
    (folder / "g.g2o").write_text(GRAPH)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    monkeypatch.setattr(jaxreg, "register", _register_s1_onto_s0)
    monkeypatch.setattr(
        "jaxreg.cli.demo.sculpture_scans",
        lambda num, seed: ([_seen_from(T) for T in POSES], POSES),
    )
    given = {"multiview": scans, "register": scans[1::-1], "average": ["g.g2o"]}
    assert main([command, *given.get(command, []), "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["status"] == "CONVERGED"
    assert found == json.loads(Path("jaxreg-out/result.json").read_text())
    assert captured.err == ""


def test_json_of_a_failure_is_silent_on_standard_output(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = _save_scans(folder)[:2]
    _fake_reconstruct(monkeypatch, POSES, [True, False])
    assert main(["multiview", *scans, "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "no two scans could be joined" in captured.err


def test_names_that_are_no_utf_8(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = [os.fsdecode(b"scan\xff%d.npy" % k) for k in range(3)]
    for old, new in zip(_save_scans(folder), scans, strict=True):
        os.rename(old, new)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans]) == 0
    assert sorted(os.listdir("jaxreg-out")) == FILES
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert found["names"] == [rf"scan\xff{k}" for k in range(3)]
    assert main(["info", *scans]) == 0
    assert r"scan\udcff0.npy: 3D scan" in capsys.readouterr().out


def test_without_plotly_the_other_files_are_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def missing() -> str:
        raise MissingExtraError("plotly", "The page report.html")

    scans = _save_scans(folder)
    _fake_reconstruct(monkeypatch, POSES, [True] * 3)
    monkeypatch.setattr("jaxreg.plot.report_page._plotly", missing)
    assert main(["multiview", *scans]) == 0
    assert sorted(os.listdir("jaxreg-out")) == [f for f in FILES if f != "report.html"]
    said = capsys.readouterr().out
    assert "needs the package plotly" in said
    assert "report.html" not in said.split("Written to")[1]


def test_python_m_jaxreg_is_the_command(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxreg", "multiview", str(tmp_path / "none.ply")],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        timeout=120,
    )
    assert done.returncode == 2
    assert "none.ply: no such file" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        (["average", "g.g2o", "--metod", "plain"], "--method"),
        (["multiview", "--sed", "3"], "--seed"),
        (["demo", "--devise", "cpu"], "--device"),
        (["registr", "a", "b"], "register"),
    ],
)
def test_a_wrong_word_suggests_the_right_one(
    capsys: pytest.CaptureFixture[str], wrong: list[str], meant: str
):
    with pytest.raises(SystemExit) as caught:
        main(wrong)
    assert caught.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert meant in captured.err


COMPLETE = """\
source ./completion
function=$(complete -p jaxreg | sed 's/.*-F \\([^ ]*\\).*/\\1/')
try() {
  COMP_WORDS=(jaxreg "$@") COMP_CWORD=$# COMPREPLY=()
  $function jaxreg "${@: -1}" ""
  echo "${COMPREPLY[@]}"
}
try multiv; try average --meth; try average --method c; try multiview a.ply b
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_commands_options_choices_and_files(tmp_path: Path):
    command = [sys.executable, "-m", "jaxreg", "--tyro-print-completion", "bash"]
    script = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert (script.returncode, script.stderr) == (0, "")
    (tmp_path / "completion").write_text(script.stdout)
    (tmp_path / "bunny.ply").touch()
    done = subprocess.run(
        ["bash", "-c", COMPLETE], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.splitlines() == [
        "multiview",
        "--method",
        "correntropy",
        "bunny.ply",
    ]


GRAPH = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_SE2 2 1 1 0
EDGE_SE2 0 1 1 0 1.5 1 0 0 1 0 1
EDGE_SE2 1 2 1 0 1.5 1 0 0 1 0 1
EDGE_SE2 0 2 1.1 1 3.0 1 0 0 1 0 1
"""


def test_average_lowers_the_objective(folder: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "g.g2o").write_text(GRAPH)
    assert main(["average", "g.g2o", "--method", "plain"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == [f for f in FILES if f != "merged.ply"]
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert 0 < found["objective_after"] < found["objective_before"]
    assert found["names"] == [0, 1, 2]
    assert np.shape(found["T_world_i"]) == (3, 3, 3)
    assert "objective" in capsys.readouterr().out
