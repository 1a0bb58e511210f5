"""`jaxreg info`: what files hold."""

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jaxreg.app.cli.options import Info
from jaxreg.app.describe import GRAPHS, GraphFacts, ScanFacts, describe, unit_notes
from jaxreg.io.errors import InputError, MissingExtraError
from jaxreg.io.points.read import notes_on_skipped, point_files, prose_files
from jaxreg.io.printable import printable


def run(command: Info) -> int:
    """Runs the command; returns the exit code."""
    if not command.files:
        raise InputError("No files given.\nUsage: jaxreg info FILE ...")
    found: list[tuple[Path, list[ScanFacts] | GraphFacts]] = []
    wrong: list[tuple[Path, str]] = []
    for place in command.files:
        try:
            files = _expand(place)
        except InputError as err:
            wrong.append((place, str(err)))
            continue
        for file in files:
            try:
                found.append((file, describe(file)))
            except (InputError, MissingExtraError) as err:
                wrong.append((file, str(err)))
    scans = [
        (str(file) if len(facts) == 1 else f"{file}:{scan.name}", scan)
        for file, facts in found
        if not isinstance(facts, GraphFacts)
        for scan in facts
    ]
    read = [file for file, facts in found if not isinstance(facts, GraphFacts)]
    folders = [place for place in command.files if place.is_dir()]
    notes = [
        f"{f}: holds no points, skipped." for one in folders for f in prose_files(one)
    ]
    notes += [note for file in read for note in notes_on_skipped(file)]
    notes += unit_notes(scans)
    if command.json:
        files = [_entry(file, facts) for file, facts in found]
        files += [{"file": str(file), "error": message} for file, message in wrong]
        sys.stdout.write(json.dumps({"files": files, "notes": notes}, indent=1) + "\n")
    elif found:
        blocks = [_block(file, facts) for file, facts in found]
        sys.stdout.write(printable("\n\n".join([*blocks, *notes])) + "\n")
    sys.stdout.flush()
    for _, message in wrong:
        sys.stderr.write(f"jaxreg: {printable(message)}\n")
    return 2 if wrong else 0


def _expand(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    graphs = [f for f in path.iterdir() if f.name.lower().endswith(GRAPHS)]
    try:
        return [*point_files(path), *sorted(graphs)]
    except InputError:
        if graphs:
            return sorted(graphs)
        raise


def _kind(facts: list[ScanFacts] | GraphFacts) -> str:
    if isinstance(facts, GraphFacts):
        return "pose graph"
    return "scan" if len(facts) == 1 else "archive of scans"


def _entry(file: Path, facts: list[ScanFacts] | GraphFacts) -> dict[str, Any]:
    entry: dict[str, Any] = {"file": str(file), "kind": _kind(facts)}
    if isinstance(facts, GraphFacts):
        return entry | asdict(facts)
    return entry | {"scans": [asdict(s) | {"extent": s.extent} for s in facts]}


def _block(file: Path, facts: list[ScanFacts] | GraphFacts) -> str:
    if isinstance(facts, GraphFacts):
        unknown = [f"{num} x {tag}" for tag, num in facts.unknown_lines.items()]
        start = "each" if facts.has_initial_poses else "not all"
        lines = [
            f"{file}: {facts.dim}D pose graph",
            f"  {facts.num_poses:,} poses, {facts.num_edges:,} edges, {start} with "
            "an initial pose",
        ]
        return "\n".join(
            lines + [f"  unknown lines: {', '.join(unknown)}"] * bool(unknown)
        )
    if len(facts) == 1:
        return "\n".join([f"{file}: {facts[0].dim}D scan", *_lines(facts[0])])
    lines = [f"{file}: archive of {len(facts)} scans"]
    for scan in facts:
        lines += [f"  {scan.name}: {scan.dim}D", *("  " + s for s in _lines(scan))]
    return "\n".join(lines)


def _lines(scan: ScanFacts) -> list[str]:
    extras = [
        name
        for name, found in (
            ("normals", scan.has_normals),
            ("colours", scan.has_colors),
        )
        if found
    ]
    about = "about " if scan.step > 1 else ""
    lines = [
        f"  {about}{scan.num_points:,} points, {scan.dtype}"
        + (f", with {' and '.join(extras)}" if extras else "")
    ]
    if scan.step > 1:
        lines.append(f"  large: one of {scan.step} points was looked at")
    if scan.fields:
        lines.append(f"  columns: {' '.join(scan.fields)}")
    for axis, low, high in zip("xyz", scan.low, scan.high, strict=False):
        # Map coordinates differ only far behind the point.
        size = max(scan.extent)
        digits = max(0, 3 - math.floor(math.log10(size))) if size > 0 else 6
        span = f"{low:.{digits}f} to {high:.{digits}f}"
        lines.append(f"  {axis}: {span}, extent {high - low:.4g}")
    if scan.spacing is not None:
        most = "at most " if scan.step > 1 else ""
        lines.append(f"  median spacing: {most}{scan.spacing:.3g}")
    if scan.non_finite:
        lines.append(f"  {scan.non_finite:.2%} of the rows hold NaN or inf")
    if scan.hint:
        lines.append(f"  unit: {scan.hint}")
    return lines
