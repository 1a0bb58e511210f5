"""Runs that end early lose nothing that is finished, and leave nothing half done."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import chex
import jax.numpy as jnp
import pytest

import jaxreg
from jaxreg.app.cli.main import main
from tests.app.cli.stand_ins import POSES, fake_reconstruct, left, save_scans


def test_a_failure_while_writing_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scans = save_scans(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jaxreg.app.result.write_g2o", full)
    before = left(folder)
    assert main(["multiview", *scans]) == 2
    assert left(folder) == before


def test_interruption_is_said_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxreg, "reconstruct", stopped)
    assert main(["multiview", *scans]) == 130
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_an_interruption_that_python_dropped_is_heard_again():
    code = """
import gc, signal, sys, time
from jaxreg.app.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background

def drop(*_):
    gc.callbacks.clear()
    raise KeyboardInterrupt

def run(_):
    gc.callbacks.append(drop)
    gc.collect()
    time.sleep(30)

main._run, sys.argv = run, ["jaxreg", "info"]
main.command()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "jaxreg: interrupted; no results were written.\n"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX alone has it")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_ended_says_so_and_leaves_nothing(folder: Path, number: int):
    code = """
import os, signal, sys, time
from jaxreg.app.cli import main

signal.signal(int(sys.argv[1]), signal.SIG_DFL)  # nohup has one ignored

def run(_):
    os.kill(os.getpid(), int(sys.argv[1]))
    time.sleep(30)

main._run = run
main.command()
"""
    command = [sys.executable, "-c", code, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 128 + number
    assert done.stderr == "jaxreg: interrupted; no results were written.\n"


@pytest.mark.parametrize("columns", ["40", "200"])  # of more text than a buffer, less
def test_a_reader_who_leaves_is_no_error(columns: str):
    read, write = os.pipe()
    os.close(read)
    usual = {x: os.environ[x] for x in ("PATH", "PYTHONPATH") if x in os.environ}
    with os.fdopen(write, "w") as pipe:
        command = [sys.executable, "-m", "jaxreg", "--help"]
        env = {**usual, "COLUMNS": columns}
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, env=env)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="not on this system")
@pytest.mark.parametrize(
    ("words", "code", "lines"),
    [("info s0.npy >/dev/full", 2, 1), ("--version >&- 2>&-", 0, 0)],
)
def test_output_that_nobody_can_take(folder: Path, words: str, code: int, lines: int):
    save_scans(folder)
    command = f"exec {sys.executable} -m jaxreg {words}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    assert (done.returncode, len(done.stderr.splitlines())) == (code, lines)


def test_an_interrupted_run_keeps_its_pairs_and_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    found = jaxreg.RelativeMotions(
        jnp.array([[0, 1]]),
        jnp.eye(4)[None, None],
        jnp.array([[0.7]]),
        jnp.array([[5.0]]),
        jnp.array([[0.01]]),
    )

    def stopped(*_: Any, on_pairs: Any, **__: Any) -> None:
        on_pairs(found)
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxreg, "reconstruct", stopped)
    assert main(["multiview", *scans]) == 130
    message = capsys.readouterr().err
    assert "pairs.jsonl: 1;" in message
    assert "--resume" in message
    kept = folder / "jaxreg-out" / "pairs.jsonl"
    assert kept.exists()
    # Pairs of another run are not taken for those of this one, nor lost.
    assert main(["multiview", *scans, "--resume", "--seed", "1"]) == 2
    assert "another seed" in capsys.readouterr().err
    assert kept.exists()
    given = fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--resume", "--order", "sequential"]) == 0
    options = given[0][2]
    assert options["order"] == "sequential"
    chex.assert_trees_all_equal(options["previous"], found)
    assert not kept.exists()
