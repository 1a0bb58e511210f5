"""Damaged files and bad arguments: `python -m tests.fuzz --cases 5000`.

Half of the cases are files, of every format, half are calls, of every public function.
Each runs in a child process with 10 s and 1 GB; it must end in an answer with an honest
status or in one message. `--files N` and `--calls N` show one case again.
"""

import argparse
import collections
import json
import signal
import subprocess
import sys
from pathlib import Path

from tests.fuzz.call_cases import CallCases
from tests.fuzz.file_cases import file_case
from tests.fuzz.samples import samples


ROOT = Path(__file__).parents[2]
BATCH = 1000
GOOD = ("read", "answered", "refused")
ENDS = ("tracebacks", "hangs", "over memory", "silent")


def run(kind: str, seed: int, start: int, stop: int) -> list[tuple[str, str]]:
    """The ends of the cases of a range, each with the case in words.

    Args:
        kind: one of `tests.fuzz.worker.KINDS`.
        seed: of the cases.
        start: the first of them.
        stop: one after the last.
    """
    ends: list[tuple[str, str]] = []
    while start < stop:
        last, found, code = _batch(kind, seed, start, min(start + BATCH, stop))
        ends += found
        if last is not None:
            hung = code in (-signal.SIGALRM, -signal.SIGPROF)
            ends.append(("hang" if hung else f"traceback: died by {-code}", last))
        start += len(found) + (last is not None)
    return ends


def _batch(
    kind: str, seed: int, start: int, stop: int
) -> tuple[str | None, list[tuple[str, str]], int]:
    """The case that a child died of, the ends of those before, and its exit code."""
    words = [sys.executable, "-m", "tests.fuzz.worker", kind]
    words += map(str, (seed, start, stop))
    child = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    begun, ends = None, []
    for line in map(json.loads, child.stdout.splitlines()):
        if "how" in line:
            begun = f"case {line['case']} ({line['kind']}, {line['how']})"
        else:
            ends.append((line["end"], str(begun)))
            begun = None
    if begun is None and len(ends) < stop - start:
        raise RuntimeError(f"the child ended outside a case:\n{child.stderr[-2000:]}")
    return begun, ends, child.returncode


def summary(ends: list[tuple[str, str]]) -> str:
    """`N cases: 0 tracebacks, 0 hangs, 0 over memory, 0 silent`."""
    of = collections.Counter(end.split(":")[0] for end, _ in ends)
    numbers = (of["traceback"], of["hang"], of["over memory"], of["silent"])
    parts = (f"{num} {name}" for num, name in zip(numbers, ENDS, strict=True))
    return f"{len(ends)} cases: {', '.join(parts)}"


def main() -> int:
    """Runs the command; 1 if any case ended badly."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--files", type=int, metavar="N", help="write this file here")
    parser.add_argument("--calls", type=int, metavar="N", help="make this call here")
    options = parser.parse_args()
    if options.files is not None:
        made = file_case(samples(), options.seed, options.files).made
        Path(f"case-{made.name}").write_bytes(made.data)
        print(f"case-{made.name}: {made.how}")  # noqa: T201
        return 0
    if options.calls is not None:
        cases = CallCases()
        case = cases.make(options.seed, options.calls)
        print(*cases.words(case), sep=": ")  # noqa: T201
        print(case.call.function(**case.arguments))  # noqa: T201
        return 0
    half = options.cases // 2
    ends = run("files", options.seed, 0, half)
    ends += run("calls", options.seed, 0, options.cases - half)
    bad = [(end, what) for end, what in ends if end not in GOOD]
    for end, what in bad[:40]:
        print(f"{what}: {end}")  # noqa: T201
    print(summary(ends))  # noqa: T201
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
