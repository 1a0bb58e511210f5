"""Pictures of a process of their own are those drawn here, which it is who fails."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxreg.app.plot import draw_graph, drawing, save_figure
from jaxreg.app.plot.drawing import Drawing, expecting_a_picture


EDGES = np.array([(0, 1), (1, 2), (0, 2)])
POSES = np.tile(np.eye(4), (3, 1, 1))
POSES[:, :3, 3] = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
TOLD = EDGES, POSES, POSES, np.ones(3, bool)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch):
    """One that waits, as where Matplotlib was not imported."""
    expecting = expecting_a_picture()
    with monkeypatch.context() as hidden:
        hidden.delitem(sys.modules, "matplotlib.figure", raising=False)
        hidden.setattr(drawing, "num_cores", lambda: 2)
        expecting.__enter__()
    found = drawing._Waiting.process
    assert found is not None
    yield found
    expecting.__exit__(None, None, None)
    assert found.poll() is not None


def test_none_is_started_where_it_would_gain_nothing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", sys)
    with expecting_a_picture():
        assert drawing._Waiting.process is None
    monkeypatch.delitem(sys.modules, "matplotlib.figure")
    monkeypatch.setattr(drawing, "num_cores", lambda: 1)
    with expecting_a_picture():
        assert drawing._Waiting.process is None


def test_the_file_is_the_one_that_is_drawn_here(
    tmp_path: Path, process: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch
):
    save_figure(tmp_path / "here.png", draw_graph(*TOLD))
    one = Drawing(tmp_path / "there.png", draw_graph, *TOLD)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(drawing, "_draw", None)
        one.finish()
    assert process.returncode == 0
    here, there = ((tmp_path / f"{x}.png").read_bytes() for x in ("here", "there"))
    assert here == there


def _only_here(*told: np.ndarray):
    """The process does not find this module."""
    return draw_graph(*told)


def test_what_the_process_cannot_do_is_done_here(
    tmp_path: Path, process: subprocess.Popen[bytes]
):
    one = Drawing(tmp_path / "figure.png", _only_here, *TOLD)
    one.finish()
    assert process.returncode == 1
    assert (tmp_path / "figure.png").stat().st_size > 0


@pytest.mark.parametrize("num", [3, 10_000])  # less and more than a pipe holds
def test_a_process_that_has_died_is_not_needed(
    tmp_path: Path, process: subprocess.Popen[bytes], num: int
):
    process.kill()
    process.wait()
    poses = np.resize(POSES, (num, 4, 4))
    told = EDGES, poses, poses, np.ones(num, bool)
    one = Drawing(tmp_path / "figure.png", draw_graph, *told)
    assert process.stdin is not None
    assert process.stdin.closed
    one.finish()
    assert (tmp_path / "figure.png").stat().st_size > 0


@pytest.mark.usefixtures("process")
def test_nothing_is_written_after_a_stop(tmp_path: Path):
    one = Drawing(tmp_path / "figure.png", draw_graph, *TOLD)
    one.stop()
    assert list(tmp_path.glob("*.png")) == []


def test_without_who_would_ask_it_ends(process: subprocess.Popen[bytes]):
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(timeout=60) == 0


def test_files_of_the_folder_are_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "numpy.py").write_text("open('run', 'w')")
    monkeypatch.chdir(tmp_path)
    code = (
        "import sys; sys.path.pop(0)\n"
        "from pathlib import Path\n"
        "from jaxreg.app.plot import drawing\n"
        "from jaxreg.app.plot.drawing import Drawing, _Waiting, expecting_a_picture\n"
        "drawing.num_cores = lambda: 2\n"
        "with expecting_a_picture():\n"
        "    process = _Waiting.process\n"
        "    one = Drawing(Path('figure.png'), print)\n"
        "    assert process.wait() == 1\n"  # what is printed is no figure
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not (tmp_path / "run").exists()
