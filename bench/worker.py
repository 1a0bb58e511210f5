"""The process of one workload: pins itself, measures case after case, keeps rows.

Started by `bench.run`, which gives it a task as JSON. Before each call it writes what
is being called to a file, so that the parent can tell what crashed or hangs.
"""

import importlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench import records
from bench.case import Case, Method, Options
from bench.measure import blank_row, measure
from bench.peers import PEERS, missing
from bench.records import Key, Row


def main(task: dict[str, Any]) -> None:
    """Measures the cases of a workload that are not finished."""
    os.sched_setaffinity(0, task["cores"])
    # Imported after that: threads are started when libraries load.
    module = importlib.import_module(f"bench.workloads.{task['workload']}")
    path, running = Path(task["out"]) / "rows.jsonl", Path(task["running"])
    done = records.read(path).rows if path.exists() else {}
    if not task["resume"]:
        done = {k: r for k, r in done.items() if r.run == task["run"]}
    mode = "quick" if task["quick"] else "full"
    case = None
    for case in module.cases(Options(task["quick"], Path(task["data"]))):
        case = _on_accelerators(case, alone=task["accelerator"])
        blank = blank_row(
            mode, task["workload"], case.name, task["run"], len(task["cores"])
        )
        methods = wanted(case, task["peers"], done, blank)
        if not methods:
            why = "finished before" if case.methods else "no accelerator runs it"
            print(f"{task['workload']:18.18s} {case.name}: {why}")
            continue

        def before(name: str, case: Case = case) -> None:
            library = next(m.library for m in case.methods if m.name == name)
            state = {"case": case.name, "method": name, "library": library}
            running.write_text(json.dumps(state))

        for row in measure(case, methods, blank, before):
            records.append(path, records.to_line(row))
            print(f"{task['workload']:18.18s} {summary(row)}", flush=True)
    running.unlink(missing_ok=True)
    if case is None:
        print(f"{task['workload']:18.18s} no data in {task['data']}: nothing measured")


def wanted(case: Case, peers: list[str] | None, done: dict[Key, Row], blank: Any):
    """Methods to measure: all or none, as they are compared within the same minute.

    A method that failed is not tried again, but lets the others finish; one that was
    absent counts as finished while its library is missing.
    """
    chosen = [
        m
        for m in case.methods
        if m.library not in PEERS or peers is None or m.library in peers
    ]
    found = {m.name: done.get(blank(m).key) for m in chosen}

    def finished(method: Method) -> bool:
        row = found[method.name]
        if row is None:
            return False
        return row.status != "absent" or missing(method.library) is not None

    if all(map(finished, chosen)):
        return []
    failed = {name for name, row in found.items() if row and row.status == "failed"}
    return [m for m in chosen if m.name not in failed]


def _on_accelerators(case: Case, *, alone: bool) -> Case:
    """The case with a second row on the accelerator of what can be put there.

    Or with those rows alone.
    """
    # Not before the process is pinned.
    import jax

    try:
        device = jax.devices("gpu")[0]
    except RuntimeError:
        return replace(case, methods=[]) if alone else case
    jax.config.update("jax_default_device", jax.devices("cpu")[0])

    def there(method: Method) -> Method:
        def solve(*trial: Any) -> Any:
            assert method.solve is not None
            with jax.default_device(device):
                return method.solve(*trial)

        name = f"{method.name}, {device.device_kind}"
        return replace(method, name=name, solve=solve)

    more = [there(m) for m in case.methods if m.on_accelerator]
    return replace(case, methods=more if alone else [*case.methods, *more])


def summary(row: Row) -> str:
    """One line for the terminal."""
    head = f"{row.key.case:30.30s} {row.key.method:32.32s}"
    if row.status != "ok":
        return f"{head} {row.status}: {row.why}"
    shown = [m for m in row.metrics.values() if m.key not in ("wall_ms", "memory_mib")]
    return f"{head} " + "  ".join(f"{m.key} {m.value:.4g}" for m in shown[:6])


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
