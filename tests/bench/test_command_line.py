"""Commands are measured as their users start them, and told apart when they fail."""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from bench.case import Options
from bench.workloads import command_line
from jaxreg.graph import PoseGraph
from jaxreg.io.graphs.g2o import read_g2o, write_g2o


def test_a_command_starts_where_nothing_is_compiled(monkeypatch, tmp_path: Path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    code = (
        "import importlib.util, os; print(os.listdir(), os.environ['XDG_CACHE_HOME'], "
        "*[k for k in os.environ if k.startswith(('JAX_COMP', 'JAX_ENABLE'))], "
        "importlib.util.find_spec('jaxreg').origin)"
    )
    command = [sys.executable, "-c", code]
    said = command_line._call(command, str(tmp_path), "kept").split()
    package = Path(command_line.jaxreg.__file__)
    assert said == ["[]", "kept", str(package)]


def test_a_command_that_fails_says_why():
    with pytest.raises(RuntimeError, match="absent.g2o"):
        command_line.run(["average", "absent.g2o"], seed=0)


def test_scans_are_judged_by_the_worst_seed_and_errors_in_millimetres():
    def document(placed: list[bool], e_t: float) -> dict:
        return {
            "scans": [{"placed": x} for x in placed],
            "errors": {"mean_e_R": 0.01, "mean_e_t": e_t},
            "times_s": {"compile": 3.0, "run": 2.0, "write": 1.0},
        }

    answers = [
        document([True] * 4, 0.001),
        document([True, True, True, False], 0.002),
        document([True] * 4, 0.009),
    ]
    found = {m.key: m.value for m in command_line.judge_scans(answers).metrics}
    assert found == {
        "placed": 75, "e_R": 0.01, "e_t": 2.0, "compile": 3.0, "run": 2.0
    }  # fmt: skip


def test_graphs_are_judged_alike_whoever_wrote_the_poses(tmp_path: Path):
    T_world_i = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    T_world_i[:, 0, 3] = [0, 1, 2]
    path, still = tmp_path / "out.g2o", np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    edges = np.array([[0, 1], [1, 2]])
    write_g2o(path, PoseGraph.from_edges(edges, still), T_world_i)
    graph = read_g2o(path)
    theirs = {"written": path.read_text(), "times_s": {"run": 1.0}}
    (after, run) = command_line.judge_graph(graph, [theirs]).metrics
    assert after.value == pytest.approx(2)  # both motions one unit off
    assert (run.key, run.value) == ("run", 1.0)
    ours = {"objective_before": 9.0, "objective_after": 4.0, "times_s": {"run": 1.0}}
    worse = ours | {"objective_after": 5.0}
    metrics = command_line.judge_graph(graph, [ours, worse]).metrics
    assert [(m.key, m.value) for m in metrics] == [
        ("objective before", 9.0), ("objective", 5.0), ("run", 1.0)
    ]  # fmt: skip


def test_without_data_there_is_the_demonstration(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (case,) = command_line.cases(Options(False, tmp_path))
    assert [m.name for m in case.methods] == [
        "jaxreg demo", "jaxreg demo, compiled before"
    ]  # fmt: skip
    assert all(m.in_processes for m in case.methods)
