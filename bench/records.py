"""What a result is: metrics with a direction and a tolerance, rows, files of them.

A file holds JSON lines. A line of kind "run" names the machine, its threads, the
versions and the command; a line of kind "row" is one method on one case and points to
its run. Files are only ever appended to, so that what is finished stays; of rows with
the same key the last counts. A metric carries its unit, direction and tolerance, which
no column of a data frame does: hence classes, and no pandas.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple


Better = Literal["up", "down"]
Status = Literal["ok", "absent", "failed"]


@dataclass(frozen=True)
class Metric:
    """One number.

    Attributes:
        key: its name, the same in every row that has it.
        value: median over trials or calls, or a share of the trials.
        unit: of the value; "" for a pure number.
        better: "up" where more is better, else "down".
        tolerance: by how much, in the unit, the value may be worse than that of the
            baseline; None where it is not compared (times, memory).
        spread: lower and upper quartile, where there are several values.
    """

    key: str
    value: float
    unit: str
    better: Better
    tolerance: float | None = None
    spread: tuple[float, float] | None = None

    def worse_than(self, baseline: "Metric") -> bool:
        """Whether this lost more against a baseline than its tolerance allows."""
        if baseline.tolerance is None:
            return False
        loss = self.value - baseline.value
        if self.better == "up":
            loss = -loss
        # A number that is not there is no accuracy.
        return not loss <= baseline.tolerance


class Key(NamedTuple):
    """What makes a row that row; `mode` is "quick" or "full"."""

    mode: str
    workload: str
    case: str
    method: str


@dataclass(frozen=True)
class Row:
    """One method on one case.

    Attributes:
        key: mode, workload, case and method.
        library: the package that is measured, "published" for figures of a paper.
        status: "ok", "absent" (its library does not import) or "failed".
        why: of what is not "ok".
        parameters: of the method, written out.
        data: what the case is computed on.
        trials: what is solved, `calls` of it in all.
        calls: timed calls.
        threads: cores that the process was pinned to.
        x, x_label: what a series of cases varies, for the plots.
        reference: method of the same case that its CPU time is compared with.
        metrics: by their keys.
        samples: values of single trials, by name, for the plots.
        run: the line of kind "run" that it belongs to.
    """

    key: Key
    library: str
    status: Status
    why: str = ""
    parameters: str = ""
    data: str = ""
    trials: int = 0
    calls: int = 0
    threads: int = 1
    x: float | None = None
    x_label: str = ""
    reference: str = ""
    metrics: dict[str, Metric] = field(default_factory=dict)
    samples: dict[str, list[float]] = field(default_factory=dict)
    run: str = ""

    def value(self, key: str) -> float | None:
        """Of a metric, None where the row has no such metric."""
        metric = self.metrics.get(key)
        return None if metric is None else metric.value


def share(key: str, values: Iterable[bool], tolerance: float) -> Metric:
    """The share of successes, in percent."""
    ok = [bool(v) for v in values]
    value = 100 * sum(ok) / len(ok) if ok else float("nan")
    return Metric(key, value, "%", "up", tolerance)


def error(
    key: str, value: float, unit: str, floor: float, slack: float = 0.5
) -> Metric:
    """An error: it may grow by a share of itself, or by `floor` where it is tiny."""
    tolerance = max(slack * abs(value), floor)
    return Metric(key, float(value), unit, "down", tolerance)


def to_line(row: Row) -> str:
    """A row as a line of JSON."""
    content = {"kind": "row", **row.key._asdict(), **asdict(row)}
    del content["key"]
    content["metrics"] = [
        {k: v for k, v in asdict(m).items() if v is not None}
        for m in row.metrics.values()
    ]
    return json.dumps({k: v for k, v in content.items() if v not in ("", [], {}, None)})


def from_content(content: dict[str, Any]) -> Row:
    """The inverse of `to_line`, of parsed JSON."""
    content = {k: v for k, v in content.items() if k != "kind"}
    key = Key(*(content.pop(name) for name in Key._fields))
    metrics = {}
    for parsed in content.pop("metrics", []):
        spread = parsed.get("spread")
        parsed["spread"] = None if spread is None else tuple(spread)
        metrics[parsed["key"]] = Metric(**parsed)
    return Row(key=key, metrics=metrics, **content)


class Records(NamedTuple):
    """Rows by their key, in the order of the file, and runs by their name."""

    rows: dict[Key, Row]
    runs: dict[str, dict[str, Any]]


def read(path: Path) -> Records:
    """Reads a file of records.

    A last line that was cut short, as by a power failure, is left out.

    Raises:
        ValueError: a line before the last is no record; names file and line.
    """
    records = Records({}, {})
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            content = json.loads(line)
            if content["kind"] == "run":
                records.runs[content["run"]] = content
            else:
                row = from_content(content)
                records.rows[row.key] = row
        except (ValueError, KeyError, TypeError) as err:
            if number == len(lines):
                break
            raise ValueError(f"{path}:{number}: no record: {err}") from err
    return records


def append(path: Path, line: str) -> None:
    """Adds a line; what an interruption cut short before it goes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        file.write((line + "\n").encode())
