"""Runs cases under limits of time and memory; a line of JSON for each."""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import warnings
from pathlib import Path

from tests.fuzz.call_cases import CallCases
from tests.fuzz.file_cases import FileCases


#: A case may take so much; calls that stand still are ended by the clock.
SECONDS, CLOCK, MEMORY = 10, 60, 1 << 30
KINDS = {
    "files": FileCases,
    "calls": CallCases,
    "cheap calls": lambda: CallCases(dear=False),
}


def main() -> None:
    """Runs the cases of a range."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("seed", type=int)
    parser.add_argument("start", type=int)
    parser.add_argument("stop", type=int)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        cases = KINDS[options.kind]()
        _limit_memory(options.kind)
        for number in range(options.start, options.stop):
            case = cases.make(options.seed, number)
            what, how = cases.words(case)
            _say({"case": number, "kind": what, "how": how})
            # Seconds of its own: others may be at work here.
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            signal.setitimer(signal.ITIMER_REAL, CLOCK)
            before = _peak(reset=True)
            end = cases.run(case)
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            if _peak() - before > MEMORY:
                end = "over memory"
            _say({"case": number, "end": end})


def _limit_memory(kind: str) -> None:
    # Threads and libraries that are loaded by now take address space, not memory, and
    # so do programs that are compiled.
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    room = MEMORY if kind == "files" else 8 * MEMORY
    limit = pages * resource.getpagesize() + room
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _peak(reset: bool = False) -> int:
    """Bytes held at most since it was reset."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    words = next(line.split() for line in lines if line.startswith("VmHWM"))
    return int(words[1]) * 1024


def _say(line: dict) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
