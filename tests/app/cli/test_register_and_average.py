"""What `jaxreg register` and `jaxreg average` write and tell."""

import json
import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import switched_on

import jaxreg
from jaxreg import Status
from jaxreg.app.cli.main import main
from tests.app.cli.stand_ins import (
    CLOUD,
    FILES,
    GRAPH,
    POSES,
    register_s1_onto_s0,
    registered,
    save_scans,
    shift,
)


def test_register_writes_the_motion_between_the_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)

    monkeypatch.setattr(jaxreg, "register", register_s1_onto_s0)
    assert main(["register", "s1.npy", "s0.npy"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == FILES
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert found["names"] == ["s0", "s1"]
    np.testing.assert_allclose(found["T_world_i"][1], POSES[1], atol=2e-6)
    assert found["T_target_source"] == found["T_world_i"][1]
    assert "overlap 0.930" in capsys.readouterr().out


def test_with_scale_scans_may_be_of_any_sizes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)
    np.save("mm.npy", 1000 * np.load("s1.npy"))
    monkeypatch.setattr(jaxreg, "register", register_s1_onto_s0)
    assert main(["register", "mm.npy", "s0.npy"]) == 2
    assert main(["register", "mm.npy", "s0.npy", "--method", "icp", "--scale"]) == 0
    assert "give a guess (--init)" in " ".join(capsys.readouterr().out.split())


def test_the_largest_part_of_a_graph_is_placed(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    Path("g.g2o").write_text(GRAPH)
    drop = ["--drop", "0,1", "0,2"]
    assert main(["average", "g.g2o", "--method", "plain", *drop]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "that of frame 1 has 2: poses are in the frame of the latter" in out
    assert "2 of 3 poses placed" in out
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert found["names"] == [1, 2, 0]
    assert found["T_world_i"][2] is None
    np.testing.assert_allclose(
        np.array(found["T_world_i"][1])[:2, 2], [1, 0], atol=1e-12
    )


def test_a_position_is_that_of_the_origin_in_the_target(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)
    priors = []

    def register(source: Any, target: Any, method: Any, **rest: Any) -> Any:
        priors.append(method.prior)
        return register_s1_onto_s0(source, target, method, **rest)

    monkeypatch.setattr(jaxreg, "register", register)
    place = [str(x) for x in POSES[1][:3, 3]]
    run = ["register", "s1.npy", "s0.npy", "--upright", "--deviation", "0.01"]
    assert main([*run, "--position", *place]) == 0
    assert main([*run, "--position", "9", "9", "9"]) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    middles = [np.median(np.load(f"s{k}.npy"), axis=0) for k in (0, 1)]
    centred = np.array(found["T_world_i"][1], np.float32)
    centred[:3, 3] += centred[:3, :3] @ middles[1] - middles[0]
    assert float(priors[0].log_density(jnp.asarray(centred))) == 0
    assert float(priors[1].log_density(jnp.asarray(centred))) < -1000
    assert main([*run, "--position", "1", "2"]) == 2
    assert "--position: wanted 3 finite numbers" in capsys.readouterr().err


def test_viewpoints_are_moved_with_the_scans_in_the_units_of_their_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)
    np.save("mm.npy", 1000 * np.load("s1.npy"))
    given = []

    def register(source: Any, target: Any, method: Any, **rest: Any) -> Any:
        given.append((source, target, rest["viewpoints"]))
        return register_s1_onto_s0(source, target, method, **rest)

    monkeypatch.setattr(jaxreg, "register", register)
    run = ["register", "mm.npy", "s0.npy", "--unit", "mm", "m", "--viewpoint"]
    assert main([*run, "0", "-9", "1"]) == 0
    source, target, eyes = given[0]
    for eye, points, name, unit in zip(
        eyes, (source, target), ("s1.npy", "s0.npy"), (1e-3, 1), strict=True
    ):
        moved = np.load(name)[0] - points[0]
        np.testing.assert_allclose(eye + moved, [0, -9 * unit, unit], atol=1e-5)
    assert main([*run, "0", "1"]) == 2
    assert "--viewpoint: wanted 3 finite numbers" in capsys.readouterr().err
    place = [str(x) for x in np.load("s0.npy")[3]]
    assert main(["register", "s1.npy", "s0.npy", "--viewpoint", *place]) == 2
    assert "s0.npy: has points at --viewpoint" in capsys.readouterr().err
    scaled = ["register", "s1.npy", "s0.npy", "--method", "icp", "--scale"]
    assert main([*scaled, "--viewpoint", "0", "0", "0"]) == 2
    assert "--viewpoint: not with --scale" in capsys.readouterr().err


def _fails(monkeypatch: pytest.MonkeyPatch, T: np.ndarray, status: Status) -> None:
    def register(source: np.ndarray, target: np.ndarray, method: Any, **_: Any) -> Any:
        return registered(T, status, 0.2 if np.isfinite(T).all() else 0.0)

    monkeypatch.setattr(jaxreg, "register", register)


def test_a_pose_that_is_not_believed_exits_with_3_and_can_be_looked_at(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)
    _fails(monkeypatch, shift(np.ones(3)), Status.LOW_OVERLAP)
    assert main(["register", "s1.npy", "s0.npy", "--json"]) == 3
    told = capsys.readouterr()
    assert "s1.npy onto s0.npy: LOW_OVERLAP" in told.err
    assert "--budget" in told.err
    assert "`" not in told.err
    assert "jaxreg-out/report.html" in told.err
    found = json.loads(told.out)
    assert (found["status"], found["T_world_i"][1]) == ("LOW_OVERLAP", None)
    # Nothing is written that another program would take for an answer.
    assert sorted(os.listdir("jaxreg-out")) == [
        "figure.png",
        "report.html",
        "result.json",
    ]
    assert "Best attempt, not believed: s1 onto s0" in (
        Path("jaxreg-out/report.html").read_text()
    )


def test_without_any_pose_the_result_alone_says_why(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_scans(folder)
    _fails(monkeypatch, np.full((4, 4), np.nan), Status.NON_FINITE)
    assert main(["register", "s1.npy", "s0.npy"]) == 3
    message = capsys.readouterr().err
    assert "s1.npy onto s0.npy: NON_FINITE" in message
    assert len(message.splitlines()) == 2
    assert os.listdir("jaxreg-out") == ["result.json"]


def _given_init(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    given = []

    def register(source: Any, target: Any, method: Any, **rest: Any) -> Any:
        given.append((rest.get("init"), method))
        return register_s1_onto_s0(source, target, method, **rest)

    save_scans(folder)
    monkeypatch.setattr(jaxreg, "register", register)
    return given


@pytest.mark.parametrize("kind", ["numbers", "rows", "text", "npy", "json"])
def test_a_guess_is_between_the_frames_of_the_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str
):
    given = _given_init(folder, monkeypatch)
    numbers = " ".join(map(repr, POSES[1].ravel().tolist()))
    rows = ",".join(map(repr, POSES[1][:3].ravel().tolist()))
    np.savetxt("guess.txt", POSES[1])
    np.save("guess.npy", POSES[1])
    poses = np.stack([POSES[2], POSES[2] @ POSES[1]]).tolist()
    document = {"names": ["s0", "s1"], "T_world_i": poses}
    Path("result.json").write_text(json.dumps(document))
    files = {"text": "guess.txt", "npy": "guess.npy", "json": "result.json"}
    init = {"numbers": numbers, "rows": rows, **files}[kind]
    run = ["register", "s1.npy", "s0.npy", "--method", "icp", "--init", init]
    assert main([*run, "--max-distance", "0.5"]) == 0
    T, method = given[0]
    middles = [np.median(np.load(f"s{k}.npy"), axis=0) for k in (0, 1)]
    back = shift(middles[0]) @ T @ shift(-middles[1])
    np.testing.assert_allclose(back, POSES[1], atol=1e-6)
    assert isinstance(method, jaxreg.ICP)
    assert float(jnp.asarray(method.max_correspondence_distance)) == 0.5


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--scale"], "--scale: only with --method icp"),
        (["--method", "icp", "--upright"], "--upright: only with --method filter"),
        (["--max-distance", "1"], "--max-distance: only with --method icp"),
        (["--method", "icp", "--max-distance", "-1"], "wanted a number above zero"),
        (["--init", "1 2 3"], "wanted 16 finite numbers, found 3"),
        (["--init", "none.txt"], "none.txt: no such file"),
        (["--init", "2 0 0 0 0 2 0 0 0 0 2 0"], "not orthonormal"),
        (["--init", "other.json"], "holds no poses of s0 and s1"),
    ],
)
def test_options_of_a_pair_that_cannot_be_used_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], told: str
):
    save_scans(folder)
    document = {"names": ["a", "b"], "T_world_i": POSES[:2].tolist()}
    Path("other.json").write_text(json.dumps(document))
    assert main(["register", "s1.npy", "s0.npy", *options]) == 2
    message = capsys.readouterr().err
    assert told in message
    assert len(message.splitlines()) <= 2


def test_units_are_those_of_the_files_in_json_and_of_the_target_in_points(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    given = _given_init(folder, monkeypatch)
    np.save("mm.npy", 1000 * np.load("s1.npy"))
    run = ["register", "mm.npy", "s0.npy", "--unit", "mm", "m"]
    guess = POSES[1] @ np.diag([0.001, 0.001, 0.001, 1])
    assert main([*run, "--init", " ".join(map(str, guess.ravel()))]) == 0
    assert re.search(r"inlier RMSE \S+ m\.", capsys.readouterr().out)
    np.testing.assert_allclose(np.linalg.det(given[0][0]), 1, atol=1e-5)
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    T = np.array(found["T_world_i"][1])
    np.testing.assert_allclose(T, guess, atol=2e-6)
    moved = np.load("mm.npy") @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(moved, CLOUD, atol=1e-5)
    merged = jaxreg.io.read_points("jaxreg-out/merged.ply")
    np.testing.assert_allclose(merged[40:], CLOUD, atol=1e-5)
    _, poses = jaxreg.io.read_tum("jaxreg-out/poses.tum")
    np.testing.assert_allclose(poses[1], POSES[1], atol=1e-5)


def test_a_scale_that_is_found_stays_in_the_motion(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    save_scans(folder)
    np.save("half.npy", 0.5 * np.load("s1.npy"))
    middles = [np.median(np.load(f), axis=0) for f in ("s0.npy", "half.npy")]
    T = POSES[1] @ np.diag([2.0, 2, 2, 1])

    def register(source: Any, target: Any, method: Any, **_: Any) -> Any:
        assert method.with_scale
        return registered(shift(-middles[0]) @ T @ shift(middles[1]), 0, 0.9)

    monkeypatch.setattr(jaxreg, "register", register)
    run = ["register", "half.npy", "s0.npy", "--method", "icp", "--scale"]
    assert main(run) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(found["T_world_i"][1], T, atol=5e-6)
    merged = jaxreg.io.read_points("jaxreg-out/merged.ply")
    np.testing.assert_allclose(merged[40:], CLOUD, atol=1e-5)


_HURRY = "jax_disable_most_optimizations"


@pytest.mark.parametrize("budget", [1536, 4096])
def test_what_computes_for_long_is_compiled_in_full(
    folder: Path, monkeypatch: pytest.MonkeyPatch, budget: int
):
    hurried = []

    def register(source: Any, target: Any, method: Any, **rest: Any) -> Any:
        hurried.append(jax.config.values[_HURRY])
        return register_s1_onto_s0(source, target, method, **rest)

    save_scans(folder)
    monkeypatch.setattr(jaxreg, "register", register)
    with switched_on(_HURRY, to=False):
        assert main(["register", "s1.npy", "s0.npy", "--budget", str(budget)]) == 0
        assert not jax.config.values[_HURRY]
    assert hurried == [budget == 1536]


@pytest.mark.parametrize("quick", [3, 1])
def test_large_graphs_are_compiled_in_full(
    folder: Path, monkeypatch: pytest.MonkeyPatch, quick: int
):
    hurried = []

    def averaged(*given: Any, **rest: Any) -> Any:
        hurried.append(jax.config.values[_HURRY])
        return jaxreg.average(*given, **rest)

    Path("g.g2o").write_text(GRAPH)
    command = import_module("jaxreg.app.cli.average")
    monkeypatch.setattr(command, "average", averaged)
    monkeypatch.setattr(command, "_QUICK", quick)
    with switched_on(_HURRY, to=False):
        assert main(["average", "g.g2o", "--method", "plain"]) == 0
    assert hurried == [quick == 3]


def test_average_lowers_the_objective(folder: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "g.g2o").write_text(GRAPH)
    assert main(["average", "g.g2o", "--method", "plain"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == [f for f in FILES if f != "merged.ply"]
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert 0 < found["objective_after"] < found["objective_before"]
    assert found["names"] == [0, 1, 2]
    assert np.shape(found["T_world_i"]) == (3, 3, 3)
    assert "objective" in capsys.readouterr().out


def test_average_tells_redundancy_numbers_where_there_are_any(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    Path("g.g2o").write_text(GRAPH)
    assert main(["average", "g.g2o", "--method", "plain"]) == 0
    assert "r: redundancy number." in " ".join(capsys.readouterr().out.split())

    def of_many_frames(*given: Any, **rest: Any) -> Any:
        return jaxreg.edge_report(*given, max_unknowns=1, **rest)

    command = import_module("jaxreg.app.cli.average")
    monkeypatch.setattr(command, "edge_report", of_many_frames)
    assert main(["average", "g.g2o", "--method", "plain"]) == 0
    told = capsys.readouterr().out
    assert "Largest residuals" in told
    assert "nan" not in told
    assert "redundancy" not in told


def test_average_goes_into_the_frame_of_what_is_known(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    (folder / "g.g2o").write_text(GRAPH)
    # The middle frame turned by a quarter at (5, 6); the last one's origin is wrong.
    rows = [
        "frame,px,py,x,y,sigma",
        "0,oak,1,0,5,5,0.1",
        "2,0,0,4,6,0.1",
        "2,1,0,9,9,0.1",
    ]
    (folder / "c.csv").write_text("\n".join(rows))
    pose = "1=0 -1 5 1 0 6"
    known = ["--fix", pose, "--control", "c.csv"]
    assert main(["average", "g.g2o", "--method", "plain", *known]) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(
        found["T_world_i"][1], [[0, -1, 5], [1, 0, 6], [0, 0, 1]], atol=1e-12
    )
    assert found["fixed"] == [1]
    assert [entry["frame"] for entry in found["known"]] == [0, 2, 2]
    assert [entry.get("name") for entry in found["known"]] == ["oak", None, None]
    for entry in found["known"]:
        own = np.array(found["T_world_i"][entry["frame"]]) @ [*entry["point"], 1]
        off = own[:2] - entry["surveyed"]
        np.testing.assert_allclose(entry["residual"], off, atol=1e-12)
        assert entry["normalised_residual"] == pytest.approx(
            np.linalg.norm(off) / 0.1 / np.sqrt(2)
        )
    assert "Priors, control points and levels" in capsys.readouterr().out
    again = jaxreg.io.read_g2o_known("jaxreg-out/graph.g2o")
    assert [frame for frame, _ in again.fixed] == [1]


def test_motions_are_left_out_and_forced_by_hand(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    """A square with both diagonals, and a step that says twice its length."""
    places = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    lines = [f"VERTEX_SE2 {k} {x} {y} 0" for k, (x, y) in enumerate(places)]
    info = "400 0 0 400 0 400"
    for i, j in ((0, 1), (1, 2), (2, 3), (0, 3), (0, 2), (1, 3)):
        x, y = (places[j] - places[i]) * (2 if (i, j) == (2, 3) else 1)
        lines.append(f"EDGE_SE2 {i} {j} {x} {y} 0 {info}")
    (folder / "g.g2o").write_text("\n".join(lines) + "\n")

    def averaged(*words: str) -> tuple[dict[str, Any], np.ndarray]:
        assert main(["average", "g.g2o", *words]) == 0
        found = json.loads(Path("jaxreg-out/result.json").read_text())
        return found, np.array(found["T_world_i"])[:, :2, 2]

    found, where = averaged()
    np.testing.assert_allclose(where, places, atol=1e-4)
    assert [e["weight"] > 0.5 for e in found["edges"]] == [True, True, False] + 3 * [
        True
    ]
    found, where = averaged("--force", "3,2")
    assert found["forced"] == [[2, 3]]
    assert found["edges"][2]["weight"] == 1
    # Each of the motions about it gives way.
    assert 0.2 < np.linalg.norm(where[3] - places[3]) < 0.8
    found, where = averaged("--drop", "2,3", "0, 3", "--quiet")
    assert found["dropped"] == [[2, 3], [0, 3]]
    assert [e["weight"] for e in found["edges"]][2:4] == [0, 0]
    np.testing.assert_allclose(where, places, atol=1e-4)
    capsys.readouterr()
    for words, said in [
        (["--drop", "0,9"], "--drop 0,9: no motion between these two"),
        (["--force", "2"], "--force 2: wanted two frames as I,J"),
    ]:
        assert main(["average", "g.g2o", *words]) == 2
        assert said in capsys.readouterr().err


def test_average_reads_the_motions_of_fragments(folder: Path):
    edges = [(0, 1), (1, 2), (0, 2)]
    T = [np.linalg.inv(POSES[i]) @ POSES[j] for i, j in edges]
    jaxreg.io.write_log("g.log", jaxreg.PoseGraph.from_edges(edges, np.stack(T)))
    assert main(["average", "g.log", "--method", "plain", "--quiet"]) == 0
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    np.testing.assert_allclose(found["T_world_i"], POSES, atol=1e-5)
    assert found["names"] == [0, 1, 2]
