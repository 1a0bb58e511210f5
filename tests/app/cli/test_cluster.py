"""`jaxreg multiview --cluster`: who registers the pairs, and what failures are told."""

import sys
import types
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from pathlib import Path
from typing import Any

import pytest

import jaxreg
from jaxreg.app.cli.main import main
from jaxreg.multiview.workers import WorkerError
from tests.app.cli.stand_ins import POSES, fake_reconstruct, save_scans


class KilledWorker(Exception):
    """As Dask has it."""


class _Client:
    """A scheduler that answers at one address."""

    def __init__(self, address: str, timeout: float) -> None:
        if address != "tcp://there:8786":
            raise OSError(f"Timed out after {timeout} s")

    def __enter__(self) -> "_Client":
        return self

    def __exit__(self, *_: object) -> None:
        return

    def get_executor(self) -> Executor:
        return ThreadPoolExecutor(1)


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("distributed")
    vars(module).update(Client=_Client, KilledWorker=KilledWorker)
    monkeypatch.setitem(sys.modules, "distributed", module)


@pytest.mark.parametrize(
    ("told", "kind"),
    [("local:2", ProcessPoolExecutor), ("tcp://there:8786", ThreadPoolExecutor)],
)
def test_pairs_are_given_to_the_processes_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, dask: None, told: str, kind: type
):
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *save_scans(folder), "--cluster", told]) == 0
    assert isinstance(given[0][2]["executor"], kind)


@pytest.mark.parametrize(
    ("told", "named"),
    [
        ("local:0", "--cluster local:0: wanted local:N with N from 1 to 1024"),
        ("local:two", "--cluster local:two: wanted local:N"),
        ("tcp://nobody:1", "--cluster tcp://nobody:1: no Dask scheduler answered"),
    ],
)
def test_processes_that_there_are_not_are_told(
    folder: Path,
    dask: None,
    capsys: pytest.CaptureFixture[str],
    told: str,
    named: str,
):
    assert main(["multiview", *save_scans(folder), "--cluster", told]) == 2
    assert named in capsys.readouterr().err


def test_without_dask_the_extra_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    arguments = ["multiview", *save_scans(folder), "--cluster", "tcp://there:8786"]
    assert main(arguments) == 2
    assert "jaxreg[cluster]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "named"),
    [
        (BrokenExecutor("gone"), "a process ended before its pairs were registered"),
        (KilledWorker("again"), "a process ended before its pairs were registered"),
        (WorkerError("A worker has jaxreg 9"), "A worker has jaxreg 9"),
    ],
)
def test_what_a_failing_process_leaves_is_kept_and_told(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    dask: None,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    named: str,
):
    def fails(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(jaxreg, "reconstruct", fails)
    arguments = ["multiview", *save_scans(folder), "--cluster", "tcp://there:8786"]
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert named in told
    assert "pairs kept in" in told
    assert "Traceback" not in told
