"""Writes REPORT.md and its plots from records.

By hand, without pandas: cells are numbers of three digits, spreads, ratios and reasons,
which its `to_markdown` (with tabulate) would be handed as text all the same.

Run: python -m bench.report FILE --out DIR
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from bench import plots, records
from bench.pair_table import pair_table
from bench.records import Metric, Records, Row
from bench.workloads import WORKLOADS


#: Columns after those of accuracy, with what is behind each.
COSTS = {
    "cpu_ms": "CPU ms",
    "wall_ms": "wall ms",
    "prepare_ms": "prepare ms",
    "first_s": "first call s",
    "memory_mib": "memory MiB",
}
_HEAD = """# jaxreg beside its peers

Written by `python -m bench`; do not edit. Each section names the command that measured
it and drew its plots.

How it is measured. Every workload runs in a process of its own, pinned to the number of
cores that its tables state; OpenMP, BLAS and XLA have as many threads. Methods of a
table are called in turn, in an order that changes, on the same inputs. CPU time is that
of all threads of a call, the median over all calls (five or more, or three that take
minutes) with its quartiles in brackets. `first call` is wall time of the first call,
with compilation for JAX (no compilation cache); `prepare` what is built once for all
trials, compiled before. Where wall time is far above CPU time, the machine had other
work. `memory` is how far one call lifts the resident set. Of work in other processes
there is wall time alone. `x` is CPU time over that of the table's reference in the same
run (wall time where work is in other processes). `data` and parameters are written out;
lengths that end in "of extent" are shares of the diagonal of the bounding box. A peer
that is not installed or fails has a row that says so. Rows of `--quick` are for the
gate: generated data, as many workloads at a time as there are cores.
"""


class Section(NamedTuple):
    """All rows of a workload in one mode."""

    mode: str
    workload: str
    rows: list[Row]


def write(found: Records, out: Path) -> Path:
    """Writes REPORT.md and `plots` below `out`; the path of the former."""
    (out / "plots").mkdir(parents=True, exist_ok=True)
    parts = [_HEAD, *_machines(found)]
    for section in sections(found):
        pictures = plots.draw(
            section.workload, section.mode, section.rows, out / "plots"
        )
        parts += _section(section, pictures)
    path = out / "REPORT.md"
    path.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
    return path


def sections(found: Records) -> Iterator[Section]:
    """Full workloads first, in the order of the command."""
    for mode in ("full", "quick"):
        for workload in WORKLOADS:
            rows = [r for k, r in found.rows.items() if k[:2] == (mode, workload)]
            if rows:
                yield Section(mode, workload, rows)


def _machines(found: Records) -> Iterator[str]:
    """The runs that rows point to."""
    used = {row.run for row in found.rows.values()}
    yield "## Runs\n"
    yield "| run | started | processor | cores, memory | command | versions |"
    yield "|---|---|---|---|---|---|"
    for name, run in found.runs.items():
        if name in used:
            versions = ", ".join(f"{k} {v}" for k, v in run["versions"].items())
            yield (
                f"| {name} | {run['started']} | {run['cpu']} | {run['cores']}, "
                f"{run['memory_gib']} GiB | `{run['command']}` | {versions} |"
            )
    yield ""


def _section(section: Section, pictures: list[Path]) -> Iterator[str]:
    known = WORKLOADS[section.workload]
    quick = " --quick" if section.mode == "quick" else ""
    command = f"python -m bench{quick} --only {section.workload}"
    yield f"## {section.workload}{quick}: {known.title}\n"
    yield f"{known.text}\n\n`{command}`\n"
    for path in pictures:
        yield f"![{path.stem}](plots/{path.name})\n"
    if known.pairs:
        yield from pair_table(section.rows)
    by_case = groupby(
        sorted(section.rows, key=_order(section.rows)), key=lambda r: r.key.case
    )
    for case, rows in by_case if not known.pairs else ():
        yield from _table(case, list(rows))
    yield "<details><summary>Parameters</summary>\n"
    told = dict.fromkeys((r.key.method, r.parameters) for r in section.rows)
    yield from (f"* {name}: `{text}`" for name, text in told if text)
    yield "\n</details>\n"


def _order(rows: list[Row]):
    """Cases in the order of the file, as a key to sort by."""
    cases = list(dict.fromkeys(row.key.case for row in rows))
    return lambda row: cases.index(row.key.case)


def _table(case: str, rows: list[Row]) -> Iterator[str]:
    """One case: a line per method."""
    keys = dict.fromkeys(key for row in rows for key in row.metrics)
    accuracy = [key for key in keys if key not in COSTS]
    costs = [key for key in COSTS if key in keys]
    best = next((r for r in rows if r.status == "ok"), rows[0])
    reference = next((r.reference for r in rows if r.reference), "")
    cores = "one core" if best.threads == 1 else f"{best.threads} cores"
    yield f"### {case}\n"
    yield (
        f"{best.data}; {best.trials} trial{'s' * (best.trials != 1)}, {best.calls} "
        f"calls of each method; {cores}"
        + (f"; `x` beside {reference}" if reference else "")
        + f"; run {best.run}.\n"
    )
    units = {m.key: m.unit for row in rows for m in row.metrics.values()}
    heads = [f"{k}, {units[k]}" if units[k] else k for k in accuracy]
    heads += [COSTS[k] for k in costs]
    yield f"| method | {' | '.join(heads)}{' | x' if reference else ''} |"
    yield "|---" * (1 + len(heads) + bool(reference)) + "|"
    for row in rows:
        name = f"**{row.key.method}**" if row.library == "jaxreg" else row.key.method
        if row.status != "ok":
            yield f"| {name} | {row.status}: {_plain(row.why)} |"
            continue
        cells = [_cell(row.metrics.get(k), k == costs[0]) for k in accuracy + costs]
        if reference:
            cells.append(_ratio(row, rows, reference))
        yield f"| {name} | {' | '.join(cells)} |"
    yield ""


def _plain(text: str) -> str:
    """On one line of a table."""
    return " ".join(text.split()).replace("|", "/")[:160]


def _cell(metric: Metric | None, with_spread: bool) -> str:
    if metric is None:
        return ""
    text = number(metric.value)
    if with_spread and metric.spread:
        text += f" [{number(metric.spread[0])}, {number(metric.spread[1])}]"
    return text


def number(value: float) -> str:
    """Three digits, large ones with thousands and millions marked."""
    if abs(value) >= 1e6:
        return f"{value / 1e6:.3g} M"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def _ratio(row: Row, rows: list[Row], reference: str) -> str:
    other = next((r for r in rows if r.key.method == reference), None)
    if other is None or other.status != "ok":
        return ""
    for key in ("cpu_ms", "wall_ms"):
        own, peer = row.value(key), other.value(key)
        if own is not None and peer:
            return f"{own / peer:.2f}"
    return ""


def main() -> None:
    """The report of a file that is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    print(write(records.read(options.file), options.out))


if __name__ == "__main__":
    sys.exit(main())
