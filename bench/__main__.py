"""Measures jaxreg beside its peers: accuracy, time and memory, row by row.

Writes OUT/rows.jsonl while it runs, and OUT/REPORT.md with plots in the end. Peers come
with `pip install '.[bench]'` (probreg, which builds from source and needs six and
scikit-learn, and pypose and theseus-ai, which need PyTorch, by hand); one that is
missing has a row that says so. An interrupted call goes on with --resume.
"""

import argparse
import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

from bench import gate, records, report
from bench.peers import PEERS
from bench.run import Settings, run
from bench.workloads import WORKLOADS
from jaxreg.io.atomic import require_writable
from jaxreg.io.errors import InputError


BASELINE = Path(__file__).parent / "baseline.jsonl"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--quick", action="store_true", help="generated data only, some minutes")
    known = ", ".join(WORKLOADS)
    add("--only", nargs="+", choices=WORKLOADS, metavar="NAME", help=f"of {known}")
    known = ", ".join(PEERS)
    add("--peers", metavar="LIST", help=f"with commas, of {known}; 'none' for none")
    add(
        "--out",
        type=Path,
        default=Path("bench-out"),
        metavar="DIR",
        help="for rows and report (default: ./bench-out)",
    )
    add(
        "--data",
        type=Path,
        metavar="DIR",
        help="real scans and graphs (default: JAXREG_DATA, else ../shared/data)",
    )
    add(
        "--accelerator",
        action="store_true",
        help="rows of an accelerator alone, where one is lent by the minute",
    )
    add("--resume", action="store_true", help="go on with what --out holds")
    add(
        "--gate",
        action="store_true",
        help="compare with bench/baseline.jsonl; exit code 1 where accuracy, or time "
        "beside a peer of the same run, was lost",
    )
    options = parser.parse_args(arguments)
    if options.peers is not None:
        names = [] if options.peers == "none" else options.peers.split(",")
        if unknown := sorted(set(names) - set(PEERS)):
            parser.error(
                f"--peers: no {', '.join(unknown)}; there are {', '.join(PEERS)}"
            )
        options.peers = names
    if options.data is None:
        options.data = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    elif not options.data.is_dir():
        parser.error(f"--data {options.data}: no such folder")
    if find_spec("matplotlib") is None:
        parser.error("plots need matplotlib: pip install '.[bench]'")
    try:
        require_writable(options.out)
    except InputError as err:
        parser.error(str(err))
    return options


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code: 0, or 1 for a loss, 130 when interrupted."""
    options = parse(arguments)
    names = options.only or list(WORKLOADS)
    settings = Settings(
        names,
        options.quick,
        options.peers,
        options.out,
        options.data,
        options.resume,
        options.accelerator,
    )
    if not options.quick and not options.data.is_dir():
        print(f"no data in {options.data}: workloads on generated data only")
    for name in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(name) == signal.SIG_DFL:
            signal.signal(name, _interrupt)
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
