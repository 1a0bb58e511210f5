"""Bad input is told in two lines and leaves nothing behind."""

from pathlib import Path

import numpy as np
import pytest

from jaxreg.app.cli.main import main
from jaxreg.io import write_ply
from tests.app.cli.stand_ins import CLOUD, GRAPH, left, save_scans


def _bad_inputs(folder: Path) -> dict[str, tuple[list[str], str]]:
    """Command lines that must fail, and what their message must name."""
    save_scans(folder)
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
    (folder / "g.g2o").write_text(GRAPH)
    (folder / "p.csv").write_text("frame,x,y\n0,1\n")
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
        "unit of two": ([r, "s0.npy", "mm.npy"], "register --unit mm m"),
        "one file": ([m, "s0.npy"], "s0.npy: this is one scan alone"),
        "one in archive": ([m, "one.npz"], "one.npz: this is one scan alone"),
        "no scan": ([m], "No scans given"),
        "empty folder": ([m, "hollow"], "hollow: the folder holds no point files"),
        "out is a file": ([m, *pair, "--out", "occupied"], "occupied"),
        "out below a file": ([r, *pair, "--out", "occupied/x"], "occupied"),
        "demo out": (["demo", "--out", "occupied"], "occupied"),
        "no budget": ([m, *pair, "--budget", "3"], "--budget 3: wanted a number"),
        "no such frame": ([a, "g.g2o", "--fix", "9=1 0 0 0 1 0"], "no '9'; the first"),
        "no pose": ([a, "g.g2o", "--fix", "1"], "wanted NAME=POSE"),
        "no points": ([a, "g.g2o", "--control", "p.csv"], "p.csv, line 2: wanted a"),
        "flat level": ([a, "g.g2o", "--level", "p.csv"], "--level: of what is 3D only"),
        "no steps": ([a, "g.g2o", "--budget", "0"], "--budget 0: wanted at least 1"),
        "no such device": (["demo", "--device", "tpu"], "--device tpu: JAX finds none"),
        "no gpu": ([r, *pair, "--device", "gpu"], "--device gpu: JAX finds none"),
        "bad seed": ([m, *pair, "--seed", "-1"], "--seed -1"),
        "truth missing": ([m, *pair, "--truth", "none.conf"], "none.conf"),
        "truth of others": ([m, *pair, "--truth", "other.conf"], "other.conf"),
        "three to register": ([r, *pair, "s2.npy"], "go to: jaxreg multiview"),
        "register missing": ([r, "s0.npy", "none.ply"], "none.ply"),
        "register many": ([r, "three.npz", "s0.npy"], "three.npz"),
        "graph missing": ([a, "none.g2o"], "none.g2o"),
        "graph of scans": ([a, "scan.ply"], "scan.ply: not a text file"),
        "graph cut off": ([a, "bad.g2o"], "bad.g2o, line 1"),
    }


@pytest.mark.parametrize("kind", range(29))
def test_bad_input_is_named_in_two_lines_with_exit_code_2(
    folder: Path, capsys: pytest.CaptureFixture[str], kind: int
):
    arguments, named = list(_bad_inputs(folder).values())[kind]
    before = left(folder)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert len(captured.err.splitlines()) <= 2
    assert captured.out == ""
    assert left(folder) == before


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
    try:
        code = main(wrong)
    except SystemExit as end:  # of the parser of options
        code = end.code
    assert code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert meant in captured.err
