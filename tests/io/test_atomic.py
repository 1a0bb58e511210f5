import os
import stat
from pathlib import Path

import pytest

from jaxreg.io import InputError, atomic_folder, atomic_write, require_writable


def test_appears_only_when_the_block_ends(tmp_path: Path):
    path = tmp_path / "a.txt"
    with atomic_write(path) as file:
        file.write("whole\n")
        assert not path.exists()
    assert path.read_bytes() == b"whole\n"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(TypeError), atomic_write(path, "wb") as file:
        file.writelines([b"half", "not bytes"])
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_permissions_follow_the_umask(tmp_path: Path):
    with atomic_write(tmp_path / "a.txt") as file:
        file.write("x")
    (tmp_path / "b.txt").write_text("x")
    modes = [stat.S_IMODE((tmp_path / f"{n}.txt").stat().st_mode) for n in "ab"]
    assert modes[0] == modes[1]


def test_a_folder_that_is_not_there_is_named(tmp_path: Path):
    path = tmp_path / "none" / "a.txt"
    with pytest.raises(InputError, match="none"), atomic_write(path):
        pass


def test_unknown_mode_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="mode"), atomic_write(tmp_path / "a", "a"):
        pass


def test_folder_gets_all_files_or_none(tmp_path: Path):
    out = tmp_path / "new" / "out"
    with pytest.raises(FileNotFoundError), atomic_folder(out) as staging:
        (staging / "first").write_text((tmp_path / "none").read_text())
    assert not out.exists()
    out.mkdir()
    (out / "first").write_text("old")
    with atomic_folder(out) as staging:
        (staging / "first").write_text("1")
        (staging / "second").write_text("2")
        assert (out / "first").read_text() == "old"
    assert sorted(os.listdir(out)) == ["first", "second"]
    assert (out / "first").read_text() == "1"


def test_require_writable_leaves_no_trace(tmp_path: Path):
    require_writable(tmp_path / "deep" / "er")
    assert os.listdir(tmp_path) == []
    (tmp_path / "file").write_text("")
    for bad in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(InputError, match="Choose another"):
            require_writable(bad)
