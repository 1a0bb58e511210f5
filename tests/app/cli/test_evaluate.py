"""`jaxreg evaluate`: numbers of evo and of 3DMatch's benchmark, from files."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import data_dir
from scipy.spatial.transform import Rotation

from jaxreg import PoseGraph
from jaxreg.app.cli.main import main
from jaxreg.io import write_kitti, write_log, write_tum


# By evo 1.38.1, its core alone: `APE(relation).process_data((reference, estimate))`
# and `RPE(relation, delta, Unit.frames)` of `PoseTrajectory3D(poses_se3=...,
# timestamps=...)` of the trajectories below; the estimate as it is, after
# `estimate.align(reference)`, and after `estimate.align_origin(reference)`.
EVO = {
    "none": (
        (3.420519689817289, 3.3998860683373566, 3.3026905848210646, 0.3751395350443811)
        + (2.949004407548695, 4.212253990336905, 350.99864845283287),
        (0.6166453072627972, 0.6164752015389516, 0.6158800914073318)
        + (0.014483123169352933, 0.5925927965906502, 0.6424919999905623)
        + (11.407543049076889,),
    ),
    "positions": (
        (0.060277016381543494, 0.058825319092681363, 0.06217715027622505)
        + (0.013149164897630556, 0.022141167908685665, 0.0784110838153727)
        + (0.10899956111582589,),
        (0.02535717112950792, 0.02451348645061896, 0.02627068497190331)
        + (0.006486532951158956, 0.0036309974008021787, 0.03223773676519131)
        + (0.0192895838307345,),
    ),
    "first": (
        (0.0793737948168065, 0.07319649047480513, 0.0744823974899384)
        + (0.03069972452306788, 0.0, 0.11644886103465796, 0.1890059791086149),
        (0.03800910967129736, 0.03545881420472529, 0.03572046252015311)
        + (0.013688130376332729, 0.0, 0.055684499119429506, 0.04334077254014131),
    ),
}
EVO_RPE = {
    1: (
        (0.09551331128639849, 0.09243017424494912),
        (0.03988873808631, 0.0388479912383),
    ),
    5: (
        (0.08883825565722663, 0.08625947358407184),
        (0.04374660343674, 0.0435455777819),
    ),
}
STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")


def trajectories() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Timestamps, true poses, and poses that are a little off in another frame."""
    t = np.arange(30.0)
    p = np.stack([np.cos(t / 5), np.sin(t / 5), t / 10], 1)
    r = Rotation.from_rotvec(np.stack([0.1 * t, 0.2 * np.sin(t), 0.05 * t], 1))
    dp = 0.05 * np.stack([np.sin(3 * t), np.cos(2 * t), np.sin(t + 1)], 1)
    wobble = 0.02 * np.stack([np.cos(t), np.sin(2 * t), np.cos(3 * t)], 1)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    true = np.tile(np.eye(4), (30, 1, 1))
    found = true.copy()
    true[:, :3, :3], true[:, :3, 3] = r.as_matrix(), p
    found[:, :3, :3] = (turn * r * Rotation.from_rotvec(wobble)).as_matrix()
    found[:, :3, 3] = turn.apply(p + dp) + [1, 2, 3]
    return t, true, found


def _evaluate(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    assert main(["evaluate", *arguments, "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return json.loads(captured.out)


@pytest.mark.parametrize("align", list(EVO))
@pytest.mark.parametrize("delta", list(EVO_RPE))
def test_the_numbers_are_those_of_evo(
    folder: Path, capsys: pytest.CaptureFixture[str], align: str, delta: int
):
    t, true, found = trajectories()
    write_tum("true.tum", true, timestamps=t)
    write_tum("found.tum", found, timestamps=t)
    options = ["--align", align, "--delta", str(delta)]
    told = _evaluate(capsys, "found.tum", "true.tum", *options)
    for kind, numbers in zip(("translation", "rotation"), EVO[align], strict=True):
        wanted = dict(zip(STATISTICS, numbers, strict=True))
        assert told["APE"][kind] == pytest.approx(wanted, rel=1e-9, abs=1e-7)
    for kind, (rmse, mean) in zip(
        ("translation", "rotation"), EVO_RPE[delta], strict=True
    ):
        assert told["RPE"][kind]["rmse"] == pytest.approx(rmse, rel=1e-9)
        assert told["RPE"][kind]["mean"] == pytest.approx(mean, rel=1e-9)
    assert told["e_R"] == told["APE"]["rotation"]["mean"]


def test_frames_are_matched_by_time_by_name_or_in_order(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    t, true, found = trajectories()
    write_tum("true.tum", true, timestamps=t)
    write_tum("some.tum", found[::-3], timestamps=t[::-3] + 0.004)
    told = _evaluate(capsys, "some.tum", "true.tum", "--align", "none")
    assert told["num_poses"] == [10, 10, 30]
    assert told["frames"] == sorted(t[::-3])
    first = np.linalg.norm(found[2, :3, 3] - true[2, :3, 3])
    assert told["errors"]["e_t"][0] == pytest.approx(first)
    write_kitti("true.txt", true)
    write_kitti("found.txt", found)
    in_order = _evaluate(capsys, "found.txt", "true.txt")
    write_tum("found.tum", found, timestamps=t)
    by_time = _evaluate(capsys, "found.tum", "true.tum")
    assert in_order["e_t"] == pytest.approx(by_time["e_t"], rel=1e-9)
    names = [f"s{k}" for k in range(30)]
    shuffled = np.random.default_rng(0).permutation(30)
    for file, order, poses in (
        ("true.json", np.arange(30), true),
        ("found.json", shuffled, found),
    ):
        document = {
            "names": [names[k] for k in order],
            "T_world_i": [poses[k].tolist() if k != 4 else None for k in order],
        }
        Path(file).write_text(json.dumps(document))
    by_name = _evaluate(capsys, "found.json", "true.json")
    assert by_name["frames"] == names[:4] + names[5:]
    np.testing.assert_allclose(
        by_name["errors"]["e_t"], np.delete(in_order["errors"]["e_t"], 4), atol=1e-9
    )


def _recall_of_fragments(
    found: dict[tuple[int, int], np.ndarray],
    true: dict[tuple[int, int], np.ndarray],
    information: np.ndarray,
) -> tuple[float, float]:
    """The benchmark's definition, with SciPy's quaternions."""
    right = counted = 0
    for ((i, j), T), info in zip(true.items(), information, strict=True):
        if j - i > 1:
            counted += 1
            if (i, j) in found:
                gap = np.linalg.solve(T, found[i, j])
                q = Rotation.from_matrix(gap[:3, :3]).as_quat()
                e = np.concatenate([gap[:3, 3], q[:3] * np.sign(q[3])])
                right += e @ info @ e / info[0, 0] <= 0.2**2
    tried = sum(j - i > 1 for i, j in found)
    return right / counted, right / tried


def test_recall_is_that_of_the_benchmark(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    rng = np.random.default_rng(3)
    pairs = [(i, j) for i in range(8) for j in range(i + 1, 8) if (i + j) % 5]
    T = np.tile(np.eye(4), (len(pairs), 1, 1))
    T[:, :3, :3] = Rotation.random(len(pairs), rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(len(pairs), 3))
    found = T.copy()
    turn = Rotation.from_rotvec(rng.normal(0, 0.06, (len(pairs), 3)))
    found[:, :3, :3] = found[:, :3, :3] @ turn.as_matrix()
    found[:, :3, 3] += rng.normal(0, 0.09, (len(pairs), 3))
    A = rng.normal(size=(len(pairs), 40, 6))
    A[:, :, :3] = np.eye(3)[np.arange(40) % 3]
    information = np.einsum("enk,enl->ekl", A, A)
    # Some are not found; others are of pairs without truth, or told the other way.
    others, wrong = [(0, 5), (2, 3)], np.tile(np.eye(4), (2, 1, 1))
    motions = [*found[3:10], np.linalg.inv(found[10]), *found[11:], *wrong]
    edges = [*pairs[3:10], pairs[10][::-1], *pairs[11:], *others]
    write_log("true.log", PoseGraph.from_edges(pairs, T, 8))
    write_log("found.log", PoseGraph.from_edges(edges, np.stack(motions), 8))
    with open("true.info", "w") as file:
        for (i, j), info in zip(pairs, information, strict=True):
            file.write(f"{i} {j} 8\n")
            file.writelines(" ".join(map(repr, map(float, r))) + "\n" for r in info)
    told = _evaluate(capsys, "found.log", "true.log")
    every = dict(zip(pairs[3:], found[3:], strict=True))
    every |= dict(zip(others, wrong, strict=True))
    recall, precision = _recall_of_fragments(
        every, dict(zip(pairs, T, strict=True)), information
    )
    assert 0.2 < recall < 0.8
    assert told["recall"] == pytest.approx(recall)
    assert told["precision"] == pytest.approx(precision)
    assert told["num_pairs"][0] == len(pairs) - 3


@pytest.mark.data
def test_recall_of_the_kitchen_by_the_counts_of_3dmatch(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    kitchen = data_dir("redwood_3dmatch_relative_poses", "7-scenes-redkitchen")
    told = _evaluate(capsys, f"{kitchen}/3dmatch.log", f"{kitchen}/gt.log")
    assert (told["num_right"], told["num_true"], told["num_found"]) == (383, 449, 531)


def test_a_pair_is_compared_with_the_matrix_of_its_motion(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    _, true, found = trajectories()
    poses = {"T_world_i": found[:2].tolist(), "names": ["target", "source"]}
    Path("result.json").write_text(json.dumps(poses))
    T_target_source = np.linalg.inv(true[0]) @ true[1]
    np.savetxt("truth.txt", T_target_source)
    told = _evaluate(capsys, "result.json", "truth.txt")
    T = np.linalg.inv(found[0]) @ found[1]
    assert told["num_pairs"] == [1, 1, 1]
    expected = np.linalg.norm(T[:3, 3] - T_target_source[:3, 3])
    np.testing.assert_allclose(told["e_t"]["mean"], expected, rtol=1e-9)


def test_files_and_tables_tell_the_same(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    t, true, found = trajectories()
    write_tum("true.tum", true, timestamps=t)
    write_tum("found.tum", found, timestamps=t)
    assert main(["evaluate", "found.tum", "true.tum", "--out", "told"]) == 0
    said = capsys.readouterr().out
    assert "30 frames in common, of 30 and 30 poses" in said
    assert max(map(len, said.splitlines())) <= 80
    assert "…" not in said
    written = json.loads(Path("told/evaluation.json").read_text())
    assert f"e_R = {written['e_R']:.5g} rad" in said
    assert Path("told/evaluation.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["found.tum", "none.tum"], "none.tum: no such file"),
        (["some.txt", "true.txt"], "nothing tells which are of one frame"),
        (["late.tum", "true.tum"], "have 0 frames in common"),
        (["pairs.log", "true.tum"], "holds motions of pairs"),
        (["found.tum", "true.tum", "--delta", "0"], "--delta 0: wanted at least 1"),
        (["found.tum", "true.tum", "--delta", "999"], "wanted less than the"),
        (["found.tum", "cut.txt"], "holds no poses that are read here"),
    ],
)
def test_what_cannot_be_compared_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
):
    t, true, found = trajectories()
    write_tum("true.tum", true, timestamps=t)
    write_tum("found.tum", found, timestamps=t)
    write_tum("late.tum", found, timestamps=t + 100)
    write_kitti("true.txt", true)
    write_kitti("some.txt", found[:7])
    Path("cut.txt").write_text("1 2 3\n")
    write_log("pairs.log", PoseGraph.from_edges([(0, 1)], true[:1], 2))
    assert main(["evaluate", *arguments]) == 2
    message = capsys.readouterr().err
    assert told in message
    assert len(message.splitlines()) <= 2
