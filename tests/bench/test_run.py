"""What is measured, kept, and said of what is absent, fails or is interrupted."""

import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

from bench import records, worker
from bench.case import Case, Judged, Method, Options
from bench.measure import blank_row, measure
from bench.peers import PEERS
from bench.records import Metric


def _case(*methods: Method, name: str = "case", reference: str = "") -> Case:
    return Case(
        name=name,
        data="made",
        methods=methods,
        trials=[(float(k),) for k in range(5)],
        judge=lambda found: Judged([Metric("sum", sum(found), "", "up", 0.0)]),
        reference=reference,
        items=2,
        item="things",
    )


def _method(name: str, solve, library: str = "jaxreg") -> Method:
    return Method(name, library, "none", solve)


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setitem(PEERS, "nowhere", "a_package_that_is_nowhere")
    return "nowhere"


BLANK = blank_row("quick", "fake", "case", "r", 1)


def test_a_row_has_accuracy_and_costs():
    case = _case(
        _method("a", lambda x: 2 * x), _method("b", lambda x: x), reference="b"
    )
    a, b = measure(case, list(case.methods), BLANK)
    assert (a.status, b.status) == ("ok", "ok")
    assert a.value("sum") == 20
    assert a.calls == a.trials == 5
    assert (a.reference, b.reference) == ("b", "")
    for key in ("cpu_ms", "wall_ms", "first_s", "memory_mib", "things_per_s"):
        assert a.value(key) is not None
    low, high = a.metrics["wall_ms"].spread or (1.0, 0.0)
    assert low <= a.metrics["wall_ms"].value <= high


def test_what_takes_many_minutes_is_called_once_after_the_first():
    called = []
    method = _method("slow", lambda: called.append(0) or 3.0)
    case = Case("case", "made", [method], [()], lambda found: Judged([]), once=True)
    (row,) = measure(case, [method], BLANK)
    assert (row.calls, len(called)) == (1, 2)
    assert all(row.value(k) is not None for k in ("cpu_ms", "first_s", "memory_mib"))


def test_an_absent_peer_is_a_row_and_not_called(absent: str):
    def never(_: float) -> float:
        raise AssertionError

    case = _case(_method("ours", lambda x: x), _method("theirs", never, absent))
    ours, theirs = measure(case, list(case.methods), BLANK)
    assert ours.status == "ok"
    assert (theirs.status, theirs.why) == ("absent", "not installed")
    assert theirs.library == absent


def test_a_peer_that_fails_is_a_row_and_the_others_go_on():
    def breaks(x: float) -> float:
        if x == 3:
            raise TypeError("no such argument in this version")
        return x

    def cannot_prepare():
        raise AttributeError("another version")

    late = Method("late", "jaxreg", "", prepare=cannot_prepare)
    case = _case(_method("a", lambda x: x), _method("b", breaks), late)
    a, b, c = measure(case, list(case.methods), BLANK)
    assert (a.status, a.calls) == ("ok", 5)
    assert b.status == "failed"
    assert "no such argument in this version" in b.why
    assert c.status == "failed"
    assert "another version" in c.why


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, absent: str):
    """A workload of two cases; the second is interrupted while `broken` is True."""
    module = ModuleType("bench.workloads.fake")
    state = {"broken": True, "calls": []}

    def solve(case: str):
        def call(x: float) -> float:
            state["calls"].append(case)
            if case == "two" and state["broken"]:
                raise KeyboardInterrupt
            return x

        return call

    def cases(_: Options):
        for name in ("one", "two"):
            theirs = _method("theirs", solve(name), absent)
            yield _case(_method("ours", solve(name)), theirs, name=name)

    module.__dict__["cases"] = cases
    monkeypatch.setitem(sys.modules, "bench.workloads.fake", module)
    # The test's own process is not to be pinned.
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)
    task = {
        "workload": "fake",
        "quick": True,
        "peers": None,
        "out": str(tmp_path),
        "data": str(tmp_path),
        "resume": False,
        "accelerator": False,
        "run": "first",
        "cores": [0],
        "running": str(tmp_path / "running.json"),
    }
    return state, task, tmp_path / "rows.jsonl"


def test_finished_rows_are_kept_and_resume_goes_on(fake):
    state, task, path = fake
    with pytest.raises(KeyboardInterrupt):
        worker.main(task)
    assert {k.case for k in records.read(path).rows} == {"one"}
    state["broken"] = False
    state["calls"].clear()
    worker.main(task | {"resume": True, "run": "second"})
    assert set(state["calls"]) == {"two"}
    rows = records.read(path).rows
    assert {(k.case, k.method): (r.status, r.run) for k, r in rows.items()} == {
        ("one", "ours"): ("ok", "first"),
        ("one", "theirs"): ("absent", "first"),
        ("two", "ours"): ("ok", "second"),
        ("two", "theirs"): ("absent", "second"),
    }
    worker.main(task | {"run": "third"})
    assert {r.run for r in records.read(path).rows.values()} == {"third"}
