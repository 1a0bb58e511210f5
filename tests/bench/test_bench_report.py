"""The report says what the records hold."""

import json
from pathlib import Path

from bench import records, report
from bench.records import Key, Metric, Row


def _row(method: str, library: str, points: int, ms: float) -> Row:
    metrics = {
        "success": Metric("success", 95.0, "%", "up", 1.0),
        "cpu_ms": Metric("cpu_ms", ms, "ms", "down", None, (ms - 1, ms + 1)),
    }
    reference = "theirs" if method == "ours" else ""
    key = Key("full", "averaging_outliers", f"{points} % wrong", method)
    return Row(key, library, "ok", parameters=f"of {method}", data="made graphs",
               trials=7, calls=14, x=points, x_label="% wrong", reference=reference,
               metrics=metrics, run="r")  # fmt: skip


def _write(folder: Path) -> str:
    path = folder / "rows.jsonl"
    versions = {"python": "3.11", "gtsam": "4.3"}
    line = {"kind": "run", "run": "r", "started": "now", "cpu": "a processor"}
    line |= {"cores": 2, "memory_gib": 8, "command": "python -m bench"}
    records.append(path, json.dumps(line | {"versions": versions}))
    for points in (10, 50):
        for row in (
            _row("ours", "jaxreg", points, 12.34),
            _row("theirs", "gtsam", points, 24.68),
        ):
            records.append(path, records.to_line(row))
        paper = _row("a paper's", "published", points, 0.0)
        del paper.metrics["cpu_ms"]
        records.append(path, records.to_line(paper))
        key = Key("full", "averaging_outliers", f"{points} % wrong", "third")
        records.append(
            path, records.to_line(Row(key, "kiss-matcher", "absent", "not installed"))
        )
    return report.write(records.read(path), folder).read_text()


def test_report_is_written_from_records(tmp_path: Path):
    text = _write(tmp_path)
    assert "a processor" in text
    assert "gtsam 4.3" in text
    assert "`python -m bench --only averaging_outliers`" in text
    assert "made graphs; 7 trials, 14 calls of each method" in text
    assert "| **ours** | 95 | 12.3 [11.3, 13.3] | 0.50 |" in text
    assert "| theirs | 95 | 24.7 [23.7, 25.7] | 1.00 |" in text
    assert "| a paper's | 95 |  | " in text
    assert "| third | absent: not installed |" in text
    assert "* ours: `of ours`" in text
    assert text.index("### 10 % wrong") < text.index("### 50 % wrong")


def test_plots_are_files_that_the_report_shows(tmp_path: Path):
    text = _write(tmp_path)
    assert "(plots/averaging_outliers.png)" in text
    assert (tmp_path / "plots" / "averaging_outliers.png").read_bytes()[
        :4
    ] == b"\x89PNG"


def test_numbers_have_three_digits():
    assert [report.number(x) for x in (0.012345, 12.345, 1234.5, 6.54321e7)] == [
        "0.0123",
        "12.3",
        "1,234",
        "65.4 M",
    ]
