"""Runs of `jaxreg multiview` that are killed as they write, and gone on with.

`python -m tests.app.kills` makes twelve scans of a sculpture, kills runs at ten moments
one after another, goes on with `--resume`, and compares with a run that was left alone.
"""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.app.cli.main import main
from jaxreg.datasets.sculpture import sculpture_scans


# What changes a folder, or makes sure of a file.
_CALLS = ("fsync", "mkdir", "rename", "replace", "rmdir", "unlink")
SCANS, POINTS, BUDGET = 12, 500, 256


def die_at(moment: int) -> None:
    """The process dies by SIGKILL as it comes to its so-manieth change of a disk."""
    left = [moment]

    def armed(call: Callable[..., Any]) -> Callable[..., Any]:
        def dying(*args: Any, **named: Any) -> Any:
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args, **named)

        return dying

    for name in _CALLS:
        setattr(os, name, armed(getattr(os, name)))


def fill_disk(size: int) -> None:
    """No file of the process may be larger."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def run(folder: Path, words: list[str], before: Callable[[], None]) -> int:
    """The exit code of a command that a child runs in a folder; -9 if it was killed.

    The caller must not have computed with JAX: its threads do not live in a child.
    """
    folder.mkdir(exist_ok=True)
    child = os.fork()
    if not child:
        code = 99
        try:
            os.chdir(folder)
            before()
            code = main(words)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def outcome(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """What result.json says, times aside, and the names in the folder of results."""
    out = folder / "jaxreg-out"
    document = json.loads((out / "result.json").read_text())
    del document["times_s"]
    return document, sorted(os.listdir(out))


@contextmanager
def working_folder() -> Iterator[Path]:
    """A folder with scans, `a00.npy` and so on, and room for runs beside each other."""
    with tempfile.TemporaryDirectory() as name:
        rng = np.random.default_rng(0)
        for k, scan in enumerate(sculpture_scans(SCANS)[0]):
            chosen = scan[rng.permutation(len(scan))[:POINTS]]
            np.save(Path(name) / f"a{k:02d}.npy", chosen)
        yield Path(name)


def command() -> int:
    """Runs the comparison; 1 if a run that was killed ends otherwise."""
    parser = argparse.ArgumentParser(prog="python -m tests.app.kills")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    with working_folder() as folder:
        words = ["multiview", *(f"../a{k:02d}.npy" for k in range(SCANS)), "--resume"]
        words += ["--budget", str(BUDGET), "--quiet"]
        assert run(folder / "alone", words, lambda: None) == 0
        moments = []
        while len(moments) < options.kills:
            moment = int(rng.integers(1, 25))
            if run(folder / "killed", words, lambda m=moment: die_at(m)) != -9:
                break
            moments.append(moment)
        assert run(folder / "killed", words, lambda: None) == 0
        alone, killed = outcome(folder / "alone"), outcome(folder / "killed")
    same = "the same" if alone == killed else "another"
    print(f"killed at {moments}: {same} result, {killed[1]}")  # noqa: T201
    return int(alone != killed)


if __name__ == "__main__":
    sys.exit(command())
