"""What `jaxreg register` and `jaxreg average` write and tell."""

import json
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
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
