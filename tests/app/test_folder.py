"""The folder of results: one run at a time, and either the old result or the new."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxreg.app.folder import held, result_folder
from jaxreg.io import InputError, atomic_folder


OURS = {"versions": {"jaxreg": "1"}}


def _write(folder: Path, names: dict[str, str]) -> None:
    with result_folder(folder) as staging:
        for name, text in names.items():
            (staging / name).write_text(text)


def test_two_runs_in_one_folder(tmp_path: Path):
    folder = tmp_path / "deep" / "out"
    with held(folder):
        with pytest.raises(InputError, match=f"process {os.getpid()}") as caught:
            with held(folder):
                pass
        assert len(str(caught.value).splitlines()) == 2
    assert os.listdir(tmp_path) == []


def test_the_lock_of_a_killed_run_is_taken_over(tmp_path: Path):
    code = (
        "import os, signal, sys; from jaxreg.app.folder import held\n"
        "with held(sys.argv[1]): os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)])
    assert done.returncode == -signal.SIGKILL
    assert os.listdir(tmp_path) == [".jaxreg.lock"]
    with held(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("moved", range(4))
def test_a_result_that_was_whole_appears_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: int
):
    _write(tmp_path, {n: "old" for n in ("merged.ply", "merged_1.ply", "poses.tum")})
    old = json.dumps(OURS | {"files": ["merged_1.ply"]})
    _write(tmp_path, {"result.json": old})
    replace, calls = os.replace, []

    def killed(*args: Path) -> None:
        calls.append(args)
        if len(calls) > moved + 1:  # the first one says that the result is whole
            raise SystemExit
        replace(*args)

    new = {name: "new" for name in ("merged.ply", "poses.tum", "result.json")}
    with monkeypatch.context() as patch, contextlib.suppress(SystemExit):
        patch.setattr(os, "replace", killed)
        _write(tmp_path, new)
    with held(tmp_path):
        pass
    texts = {name: (tmp_path / name).read_text() for name in os.listdir(tmp_path)}
    assert texts == new


def test_what_killed_runs_left_half_done_goes(tmp_path: Path):
    (tmp_path / ".jaxreg-part-a1").mkdir()
    (tmp_path / ".jaxreg-part-a1" / "merged.ply").write_text("half")
    (tmp_path / ".pairs.jsonl.a1.part").write_text("half")
    (tmp_path / ".mine.part").write_text("mine")
    with held(tmp_path):
        pass
    assert os.listdir(tmp_path) == [".mine.part"]


def test_a_folder_in_the_way_leaves_the_old_result(tmp_path: Path):
    _write(tmp_path, {"graph.g2o": "old", "result.json": "old"})
    (tmp_path / "merged.ply").mkdir()
    with pytest.raises(InputError, match=r"merged\.ply: a folder is where"):
        _write(tmp_path, {"graph.g2o": "new", "merged.ply": "", "result.json": "new"})
    assert sorted(os.listdir(tmp_path)) == ["graph.g2o", "merged.ply", "result.json"]
    assert (tmp_path / "graph.g2o").read_text() == "old"


@pytest.mark.parametrize(
    ("document", "gone"),
    [
        (OURS, {"merged_1.ply"}),
        ({"versions": {"other": "1"}}, set()),
        ({}, set()),
        ({"versions": 3}, set()),
    ],
)
def test_only_our_own_files_are_replaced(tmp_path: Path, document: dict, gone: set):
    names = ["merged_1.ply", "thesis.tex", "notes.ply", "../outside", "merged_2.ply"]
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / "outside").write_text("mine")
    for name in names[:3]:
        (folder / name).write_text("mine")
    (folder / "merged_2.ply").symlink_to(folder / "thesis.tex")
    (folder / "poses_1.tum").mkdir()
    listed = [*names, "poses_1.tum", ".", "", 7] if document == OURS else names
    text = json.dumps(document | {"files": [n for n in listed if isinstance(n, str)]})
    (folder / "result.json").write_text(text)
    before = set(os.listdir(folder))
    _write(folder, {"result.json": "new"})
    assert before - set(os.listdir(folder)) == gone
    assert (tmp_path / "outside").exists()


def test_a_failed_block_leaves_no_folder(tmp_path: Path):
    with pytest.raises(ValueError, match="half"), atomic_folder(tmp_path / "new"):
        raise ValueError("half")
    assert os.listdir(tmp_path) == []
