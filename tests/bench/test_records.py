"""The contract of a result: directions, tolerances, files that survive."""

import json
from pathlib import Path

import pytest

from bench import records
from bench.records import Key, Metric, Row


def _row(method: str = "ours", value: float = 1.0) -> Row:
    metrics = {
        "e_rot": Metric("e_rot", value, "deg", "down", 0.5),
        "cpu_ms": Metric("cpu_ms", 3.0, "ms", "down", None, (2.0, 4.0)),
    }
    key = Key("full", "local_pairs", "500 points", method)
    return Row(key, "jaxreg", "ok", data="generated", x=500.0, metrics=metrics,
               samples={"e_rot": [1.0, 2.0]}, run="r")  # fmt: skip


@pytest.mark.parametrize(
    ("better", "value", "worse"),
    [
        ("down", 1.4, False),
        ("down", 1.6, True),
        ("down", 0.1, False),
        ("up", 0.6, False),
        ("up", 0.4, True),
        ("up", 9.0, False),
        ("up", float("nan"), True),
        ("down", float("nan"), True),
    ],
)
def test_worse_is_by_direction_and_tolerance(better, value, worse):
    old = Metric("m", 1.0, "", better, 0.5)
    assert Metric("m", value, "", better, 0.5).worse_than(old) is worse


def test_a_row_comes_back_from_its_line(tmp_path: Path):
    path = tmp_path / "rows.jsonl"
    row = _row()
    records.append(path, json.dumps({"kind": "run", "run": "r", "cpu": "some"}))
    records.append(path, records.to_line(row))
    found = records.read(path)
    assert found.rows == {row.key: row}
    assert found.runs["r"]["cpu"] == "some"
    content = json.loads(records.to_line(row))
    assert content["metrics"][0] == {
        "key": "e_rot",
        "value": 1.0,
        "unit": "deg",
        "better": "down",
        "tolerance": 0.5,
    }


def test_a_line_cut_short_is_left_out_and_replaced(tmp_path: Path):
    path = tmp_path / "rows.jsonl"
    records.append(path, records.to_line(_row("first")))
    with path.open("a") as file:
        file.write(records.to_line(_row("second"))[:40])
    assert [k.method for k in records.read(path).rows] == ["first"]
    records.append(path, records.to_line(_row("third")))
    assert [k.method for k in records.read(path).rows] == ["first", "third"]
