"""Measures jaxreg beside its peers: accuracy, time and memory, row by row.

Run: python -m bench [--quick] [--only NAME ...] [--peers LIST] [--out DIR] [--data DIR]
     [--resume] [--gate]

Writes OUT/rows.jsonl while it runs, and OUT/REPORT.md with plots in the end. Peers come
with `pip install '.[bench]'` (probreg, which builds from source and needs six and
scikit-learn, by hand); one that is missing has a row that says so. --quick is a
selection on generated data, in about two minutes. --resume goes on where an earlier
call with the same DIR was interrupted. --gate compares with bench/baseline.jsonl and
ends with code 1 where accuracy, or time beside a peer of the same run, was lost.
"""

import argparse
import os
import signal
import sys
from pathlib import Path

from bench import gate, records, report
from bench.peers import PEERS
from bench.run import Settings, run
from bench.workloads import WORKLOADS


BASELINE = Path(__file__).parent / "baseline.jsonl"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=WORKLOADS,
        metavar="NAME",
        help=", ".join(WORKLOADS),
    )
    parser.add_argument(
        "--peers", metavar="LIST", help=f"of {','.join(PEERS)}; 'none' for none"
    )
    parser.add_argument("--out", type=Path, default=Path("bench-out"), metavar="DIR")
    data = os.environ.get("JAXREG_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(data), metavar="DIR")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--gate", action="store_true")
    options = parser.parse_args(arguments)
    if options.peers is not None:
        names = [] if options.peers == "none" else options.peers.split(",")
        if unknown := sorted(set(names) - set(PEERS)):
            parser.error(
                f"--peers: no {', '.join(unknown)}; there are {', '.join(PEERS)}"
            )
        options.peers = names
    return options


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code: 0, or 1 for a loss, 130 when interrupted."""
    options = parse(arguments)
    names = options.only or list(WORKLOADS)
    settings = Settings(
        names, options.quick, options.peers, options.out, options.data, options.resume
    )
    if not options.quick and not options.data.is_dir():
        print(f"no data in {options.data}: workloads on generated data only")
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        found = run(settings)
    except KeyboardInterrupt:
        print(f"interrupted; finished rows are in {settings.path}, --resume goes on")
        return 130
    print(f"report: {report.write(found, options.out)}")
    if not options.gate:
        return 0
    verdict = gate.compare(found, records.read(BASELINE), settings.mode, names)
    print(gate.text(verdict))
    return 0 if verdict.passed else 1


def _interrupt(*_: object) -> None:
    """Ends the processes of workloads, too."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
