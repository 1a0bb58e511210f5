"""Do the tests notice a wrong line? `python tests/mutants.py`.

Each entry of `mutants.toml` is a line made wrong, and the tests that should fail then.
A copy of the package gets one of them at a time, and those tests run on it:

    killed     a test failed, or did not end in time
    lived      all passed: a test is missing, or the line is not needed
    invalid    the tests could not run

Before, the tests named pass on the package as it is, else nothing is told. The exit
status is 1 where fewer than `--share` of the mutants are killed.
"""

import argparse
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple


ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".toml")
COPIED = ("jaxreg", "tests", "pyproject.toml")


class Mutant(NamedTuple):
    """A line of the package made wrong.

    Attributes:
        room: of the package.
        file: below `jaxreg`.
        old: what stands there, exactly once.
        new: what takes its place.
        tests: of pytest, below `tests`.
    """

    room: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        old, new = (" ".join(x.split()) for x in (self.old, self.new))
        return f"{self.file}: `{old}` -> `{new or ' '}`"


class Outcome(NamedTuple):
    """What the tests said of a mutant, in how many seconds."""

    mutant: Mutant
    verdict: str
    seconds: float
    output: str


def mutants(path: Path = LIST) -> list[Mutant]:
    """All of a list, room by room."""
    rooms = tomllib.loads(path.read_text(encoding="utf-8"))
    return [
        Mutant(room, row["file"], row["old"], row["new"], tuple(row["tests"]))
        for room, rows in rooms.items()
        for row in rows
    ]


def faults(found: Iterable[Mutant], root: Path = ROOT) -> list[str]:
    """What is wrong with a list: fragments that are not there once, tests that are not.

    A fragment that is gone or stands twice is no mutant of the line that it was.
    """
    wrong = []
    for mutant in found:
        path = root / "jaxreg" / mutant.file
        count = (
            path.read_text(encoding="utf-8").count(mutant.old) if path.exists() else 0
        )
        if count != 1 or mutant.old == mutant.new:
            wrong.append(f"{mutant.file}: {mutant.old!r} stands there {count} times")
        for test in mutant.tests:
            file, *name = test.split("::")
            path = root / "tests" / file
            name = f"def {name[-1].split('[')[0]}(" if name else ""
            if not path.exists() or name not in path.read_text(encoding="utf-8"):
                wrong.append(f"{mutant.file}: there is no test {test}")
    return wrong


def main(words: list[str] | None = None) -> int:
    """Runs what the command line asks for."""
    options = _parser().parse_args(words)
    chosen = [
        m
        for m in mutants()
        if (not options.only or m.room in options.only)
        and options.match in f"{m.file} {m.old}"
    ]
    if options.list:
        for mutant in chosen:
            print(f"{mutant.room:14s} {mutant}")  # noqa: T201
        return 0
    for fault in (wrong := faults(chosen)):
        print(fault, file=sys.stderr)  # noqa: T201
    if wrong or not chosen:
        return 2
    with tempfile.TemporaryDirectory() as folder:
        copies: queue.Queue[Path] = queue.Queue()
        for job in range(options.jobs):
            copies.put(_copy(Path(folder) / str(job)))
        if not options.no_baseline and not _passes(copies, chosen, options.limit):
            return 2
        with ThreadPoolExecutor(options.jobs) as pool:
            results = pool.map(lambda m: _outcome(m, copies, options.limit), chosen)
            outcomes = [_told(outcome, options.verbose) for outcome in results]
    print("\n" + table(outcomes))  # noqa: T201
    killed = sum(o.verdict == "killed" for o in outcomes)
    return int(killed < options.share * len(outcomes))


def table(outcomes: list[Outcome]) -> str:
    """Markdown: the rooms, and the mutants that were not killed."""
    lines = ["| room | mutants | killed |", "|---|---|---|"]
    for room in dict.fromkeys(o.mutant.room for o in outcomes):
        verdicts = [o.verdict for o in outcomes if o.mutant.room == room]
        lines.append(f"| {room} | {len(verdicts)} | {verdicts.count('killed')} |")
    killed = sum(o.verdict == "killed" for o in outcomes)
    lines.append(f"| all | {len(outcomes)} | {killed} |")
    rest = [o for o in outcomes if o.verdict != "killed"]
    return "\n".join([*lines, "", *(f"* {o.verdict}: {o.mutant}" for o in rest)])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--list", action="store_true", help="show the mutants and end")
    add("--only", action="append", metavar="ROOM", help="of these rooms alone")
    add("--match", default="", help="of files and lines that hold this alone")
    add("--jobs", type=int, default=1, help="mutants at a time")
    add("--limit", type=float, default=600, help="seconds for the tests of a mutant")
    add("--share", type=float, default=0.85, help="of the mutants to kill")
    add("--no-baseline", action="store_true", help="take it that the tests pass now")
    add("--verbose", action="store_true", help="show what pytest said of survivors")
    return parser


def _copy(folder: Path) -> Path:
    folder.mkdir()
    for name in COPIED:
        if (ROOT / name).is_dir():
            skip = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, folder / name, ignore=skip)
        else:
            shutil.copy(ROOT / name, folder / name)
    return folder


def _passes(copies: "queue.Queue[Path]", chosen: list[Mutant], limit: float) -> bool:
    """Whether the tests of all pass on the package as it is."""
    copy = copies.get()
    tests = tuple(dict.fromkeys(t for m in chosen for t in m.tests))
    code, output = _pytest(copy, tests, limit * len(chosen))
    copies.put(copy)
    if code:
        print(output, "\nthe tests fail without a mutant", file=sys.stderr)  # noqa: T201
    return code == 0


def _outcome(mutant: Mutant, copies: "queue.Queue[Path]", limit: float) -> Outcome:
    copy = copies.get()
    path, begin = copy / "jaxreg" / mutant.file, time.monotonic()
    text = path.read_text(encoding="utf-8")
    try:
        path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        code, output = _pytest(copy, mutant.tests, limit)
    finally:
        path.write_text(text, encoding="utf-8")
        copies.put(copy)
    verdict = {0: "lived", 1: "killed"}.get(code, "invalid")
    return Outcome(mutant, verdict, time.monotonic() - begin, output)


def _pytest(copy: Path, tests: tuple[str, ...], limit: float) -> tuple[int, str]:
    """The exit status and what was said; as failed where the time is up."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
    data = os.environ.get("JAXREG_DATA", ROOT / ".." / "shared" / "data")
    environment["JAXREG_DATA"] = str(Path(data).resolve())
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["-p", "no:dash", "-o", "addopts=", "--hypothesis-seed=0"]
    command += [f"tests/{test}" for test in tests]
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True,
            timeout=limit, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 1, f"no end in {limit:.0f} s"
    return done.returncode, done.stdout[-4000:] + done.stderr[-1000:]


def _told(outcome: Outcome, verbose: bool) -> Outcome:
    mutant, verdict, seconds, output = outcome
    print(f"{verdict:8s} {seconds:5.0f} s  {mutant}", flush=True)  # noqa: T201
    if verdict == "invalid" or verbose and verdict == "lived":
        print(output, flush=True)  # noqa: T201
    return outcome


if __name__ == "__main__":
    sys.exit(main())
