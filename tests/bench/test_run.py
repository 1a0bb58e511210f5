"""What is measured, kept, and said of what is absent, fails or is interrupted."""

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest

from bench import records, run, worker
from bench.__main__ import parse
from bench.case import Case, Judged, Method, Options
from bench.measure import blank_row, measure
from bench.memory import growth_mib
from bench.peers import PEERS, missing
from bench.records import Metric
from bench.workloads import WORKLOADS


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


def test_published_figures_are_a_row_and_not_called():
    figures = [Metric("sum", 7.0, "", "up")]
    paper = Method("the paper's", "published", "its own data", metrics=figures)
    case = _case(_method("ours", lambda x: x), paper)
    _, row = measure(case, list(case.methods), BLANK)
    assert (row.status, row.library, row.calls) == ("ok", "published", 0)
    assert row.metrics == {"sum": figures[0]}


def test_what_is_known_of_a_method_stands_with_what_is_measured():
    known = [Metric("look_ups", 3.0, "", "down")]
    ours = Method("ours", "jaxreg", "", lambda x: x, metrics=known)
    (row,) = measure(_case(ours), [ours], BLANK)
    assert (row.value("sum"), row.value("look_ups")) == (10, 3)


def test_work_in_other_processes_has_wall_time_alone_and_no_call_for_memory():
    calls = []
    inside = _method("inside", lambda x: x)
    outside = Method("outside", "jaxreg", "", lambda x: calls.append(x) or x,
                     in_processes=True)  # fmt: skip
    rows = measure(_case(inside, outside), [inside, outside], BLANK)
    inner, outer = (set(row.metrics) for row in rows)
    assert inner - outer == {"cpu_ms", "memory_mib"}
    assert len(calls) == 6  # the first, then one of each trial


def test_methods_are_interleaved():
    order = []
    methods = [
        _method(name, lambda x, name=name: order.append((x, name)) or x)
        for name in ("a", "b")
    ]
    measure(_case(*methods), methods, BLANK)
    timed = order[2:-2]  # between the first calls and those that watch memory
    assert [x for x, _ in timed] == [float(k) for k in range(5) for _ in range(2)]
    assert {name for _, name in timed[:2]} == {"a", "b"}


def test_fewer_than_five_calls_are_refused():
    with pytest.raises(ValueError, match="fewer than 5 calls"):
        Case("few", "", [], [()] * 4, lambda _: Judged([]))
    with pytest.raises(ValueError, match="fewer than 3 calls"):
        Case("few", "", [], [()] * 2, lambda _: Judged([]), long=True)


def test_memory_of_a_call_is_about_what_it_holds():
    assert 60 < growth_mib(lambda: np.ones(8 * 2**20).sum()) < 80


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


def test_peers_that_are_not_asked_for_have_no_row(fake):
    state, task, path = fake
    state["broken"] = False
    worker.main(task | {"peers": []})
    assert {k.method for k in records.read(path).rows} == {"ours"}


def test_an_accelerator_adds_a_row_of_what_can_be_put_there(monkeypatch):
    cpu = jax.devices("cpu")
    monkeypatch.setattr(jax, "devices", lambda kind: cpu)

    def solve(x: float) -> float:
        return float(jax.numpy.asarray(x))

    method = Method("batch", "jaxreg", "", solve, on_accelerator=True)
    try:
        case = worker._on_accelerators(_case(method, _method("single", solve)))
    finally:
        jax.config.update("jax_default_device", None)
    names = [m.name for m in case.methods]
    assert names == ["batch", "single", f"batch, {cpu[0].device_kind}"]
    rows = measure(case, list(case.methods), BLANK)
    assert [row.value("sum") for row in rows] == [10.0] * 3


def test_a_workload_without_its_data_says_so(fake, monkeypatch, capsys):
    _, task, path = fake
    module = sys.modules["bench.workloads.fake"]
    monkeypatch.setitem(module.__dict__, "cases", lambda options: iter(()))
    worker.main(task)
    assert f"no data in {task['data']}" in capsys.readouterr().out
    assert not path.exists()


def test_a_process_that_dies_or_hangs_is_told(tmp_path: Path):
    running = tmp_path / "running.json"

    def why(code: str, longest: float) -> str:
        command = [sys.executable, "-c", code]
        return run._process(
            command, dict(os.environ), running, longest, threading.Event()
        )

    assert "code 3" in why("import os; os._exit(3)", 60)
    write = f"import pathlib, time; pathlib.Path({str(running)!r}).touch(); "
    assert "no answer" in why(write + "time.sleep(60)", 0.5)
    assert why("", 60) == ""


def test_an_interruption_ends_all_processes_and_leaves_no_row(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Of two workloads at a time, each with a process of its own beneath it."""
    beat = f"while true; do date +%s%N > {tmp_path}/beat; sleep 0.05; done"
    script = tmp_path / "worker"
    script.write_text(f"#!/bin/sh\nsh -c '{beat}' &\nwait\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    settings = run.Settings(
        ["neighbours", "gradients"], True, None, tmp_path, tmp_path, False
    )
    beating, main = tmp_path / "beat", threading.get_ident()

    def interrupt() -> None:
        while not beating.exists():
            time.sleep(0.05)
        signal.pthread_kill(main, signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        run.run(settings)
    last = beating.read_text()
    time.sleep(0.3)
    assert beating.read_text() == last
    assert not records.read(settings.path).rows


def test_a_method_that_kills_its_process_is_a_row(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    ends = iter(["its process ended with code -11", ""])

    def process(command, environment, running: Path, longest, stop) -> str:
        running.write_text('{"case": "two", "method": "theirs", "library": "open3d"}')
        return next(ends)

    monkeypatch.setattr(run, "_process", process)
    settings = run.Settings(["neighbours"], True, None, tmp_path, tmp_path, False)
    (row,) = run.run(settings).rows.values()
    assert (row.key.method, row.library, row.status) == ("theirs", "open3d", "failed")
    assert row.why == "its process ended with code -11"


def test_each_core_is_a_device_where_a_workload_asks_for_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    asked = {}

    def process(command: list[str], environment: dict, *_: object) -> str:
        workload = json.loads(command[-1])["workload"]
        asked[workload] = environment.get("XLA_FLAGS", "")
        return ""

    monkeypatch.setattr(run, "_process", process)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=")
    names = ["averaging_batch", "local_batch"]
    run.run(run.Settings(names, False, None, tmp_path, tmp_path, False))
    flag = "--xla_force_host_platform_device_count=3"
    assert asked["averaging_batch"].split() == ["--xla_dump_to=", flag]
    assert asked["local_batch"] == "--xla_dump_to="


def test_every_workload_is_a_module_and_every_peer_a_name():
    folder = Path(worker.__file__).parent / "workloads"
    for name in WORKLOADS:
        assert (folder / f"{name}.py").is_file()
    assert missing("scipy") is None


def test_what_cannot_be_used_is_named_and_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    (tmp_path / "file").touch()
    for words, named in (
        (["--only", "nothing"], "nothing"),
        (["--peers", "scipy,nobody"], "nobody"),
        (["--data", str(tmp_path / "absent")], "absent"),
        (["--out", str(tmp_path / "file")], "file"),
    ):
        with pytest.raises(SystemExit) as refused:
            parse(words)
        assert refused.value.code == 2
        assert named in capsys.readouterr().err
    assert parse(["--peers", "none"]).peers == []
