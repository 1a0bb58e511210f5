"""What `jaxreg register` and `jaxreg average` write and tell."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxreg
from jaxreg import Status
from jaxreg.app.cli.main import main
from tests.app.cli.stand_ins import (
    FILES,
    GRAPH,
    POSES,
    left,
    register_s1_onto_s0,
    registered,
    save_scans,
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
    assert "overlap 0.930" in capsys.readouterr().out


@pytest.mark.parametrize("status", [Status.LOW_OVERLAP, Status.NON_FINITE])
def test_register_without_overlap_exits_with_2(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    status: Status,
):
    save_scans(folder)

    def register(source: np.ndarray, target: np.ndarray, method: Any, **_: Any) -> Any:
        return registered(np.full((4, 4), np.nan), status, 0.0)

    monkeypatch.setattr(jaxreg, "register", register)
    before = left(folder)
    assert main(["register", "s1.npy", "s0.npy"]) == 2
    message = capsys.readouterr().err
    assert f"s1.npy onto s0.npy: {status.name}" in message
    assert len(message.splitlines()) == 2
    assert left(folder) == before


def test_average_lowers_the_objective(folder: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "g.g2o").write_text(GRAPH)
    assert main(["average", "g.g2o", "--method", "plain"]) == 0
    assert sorted(os.listdir("jaxreg-out")) == [f for f in FILES if f != "merged.ply"]
    found = json.loads(Path("jaxreg-out/result.json").read_text())
    assert 0 < found["objective_after"] < found["objective_before"]
    assert found["names"] == [0, 1, 2]
    assert np.shape(found["T_world_i"]) == (3, 3, 3)
    assert "objective" in capsys.readouterr().out
