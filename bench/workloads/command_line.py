"""Commands from an empty folder to written files, each in a process of its own.

With an empty cache folder they compile, as a user's first call does; "compiled before"
keeps that folder from call to call.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import jaxreg
from bench import peers
from bench.case import Case, Judged, Method, Options
from bench.motion_scans import SETS
from bench.records import Metric, error, share
from bench.start_plot import PARTS
from jaxreg import Status
from jaxreg.graph import PoseGraph
from jaxreg.io.graphs.g2o import read_g2o, read_g2o_poses
from jaxreg.metrics import chordal_objective


SEEDS = range(3)
GRAPHS = ("tinyGrid3D", "sphere2500", "parking-garage")
PEER = "GTSAM script"


def cases(options: Options) -> Iterator[Case]:
    """The demonstration, and scans and graphs where they lie."""
    yield _scans("sculpture, 12 views", "12 scans of 8,000 points", ["demo"])
    data = options.data.resolve()  # commands run elsewhere
    for name, (folder, scans, truth) in SETS.items():
        file = data / folder / scans
        if file.exists():
            words = ["multiview", str(file), "--truth", str(data / folder / truth)]
            yield _scans(f"Stanford {name}", scans, words)
        if file.exists() and name == "bunny":
            yield _pair(file)
    for name in GRAPHS:
        path = data / "pose_graphs" / f"{name}.g2o"
        if path.exists():
            yield _graph(path)


def _scans(name: str, data: str, words: list[str]) -> Case:
    return Case(
        name=name,
        data=data,
        methods=_own(f"jaxreg {words[0]}", words),
        trials=[(seed,) for seed in SEEDS],
        judge=judge_scans,
        long=True,
    )


def _pair(path: Path) -> Case:
    words = ["register", f"{path}:bun045", f"{path}:bun000"]
    return Case(
        name="two Bunny scans",
        data=f"{path.name}, 40,000 points each",
        methods=_own("jaxreg register", words),
        trials=[(seed,) for seed in SEEDS],
        judge=judge_pair,
        long=True,
    )


def _graph(path: Path) -> Case:
    graph = read_g2o(path)
    words = ["average", str(path)]
    told = "python bench/peers/gtsam_script.py IN.g2o OUT.g2o"
    script = Method(PEER, "gtsam", told, partial(_script, path), in_processes=True)
    return Case(
        name=path.stem,
        data=f"{path.name}, {graph.num_poses} poses, {graph.num_edges} edges",
        methods=[
            *_own("jaxreg average", words),
            *_own("jaxreg average --method plain", [*words, "--method", "plain"]),
            script,
        ],
        trials=[(seed,) for seed in SEEDS],
        judge=partial(judge_graph, graph),
        reference=PEER,
        long=True,
    )


def _own(name: str, words: list[str]) -> list[Method]:
    """A command as it is, and with the programs that earlier calls compiled."""
    told = " ".join(["jaxreg", *(Path(word).name for word in words), "--seed SEED"])
    kept = partial(run, words, cache=tempfile.mkdtemp())
    return [
        Method(name, "jaxreg", told, partial(run, words), in_processes=True),
        Method(f"{name}, compiled before", "jaxreg", told, kept, in_processes=True),
    ]


def run(words: list[str], seed: int, cache: str | None = None) -> dict[str, Any]:
    """The result.json of a command.

    Args:
        words: after `jaxreg`.
        seed: of its random numbers.
        cache: folder of compiled programs; an empty one if None.

    Raises:
        RuntimeError: if the command fails; says what it said.
    """
    command = [sys.executable, "-m", "jaxreg", *words, "--seed", str(seed)]
    with tempfile.TemporaryDirectory() as folder:
        _call(command, folder, cache or f"{folder}/cache")
        return json.loads(Path(folder, "jaxreg-out", "result.json").read_text())


def _script(path: Path, seed: int) -> dict[str, Any]:
    """What GTSAM's user has in the end; nothing is drawn."""
    del seed
    script = Path(peers.__file__).with_name("gtsam_script.py")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out.g2o")
        command = [sys.executable, str(script), str(path), str(out)]
        seconds = float(_call(command, folder, f"{folder}/cache"))
        return {"written": out.read_text(), "times_s": {"run": seconds}}


def _call(command: list[str], folder: str, cache: str) -> str:
    """Runs a command in a folder; what it prints."""
    environment = os.environ | {"XDG_CACHE_HOME": cache}
    # The library that is measured here, whatever else is installed.
    environment["PYTHONPATH"] = str(Path(jaxreg.__file__).parents[1])
    # As installed: there the library's modules are bytecode from the second run on.
    unset = "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "PYTHONDONTWRITEBYTECODE"
    for name in unset:
        environment.pop(name, None)
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or f"ended with code {done.returncode}")
    return done.stdout


def judge_scans(answers: list[Any]) -> Judged:
    """Scans placed, at the worst seed, and errors and times: medians over the seeds."""
    placed = [np.mean([scan["placed"] for scan in a["scans"]]) for a in answers]
    e_R, e_t = ([a["errors"][key] for a in answers] for key in ("mean_e_R", "mean_e_t"))
    return Judged(
        [
            Metric("placed", 100 * float(min(placed)), "%", "up", 1.0),
            error("e_R", float(np.median(e_R)), "rad", 2e-4),
            error("e_t", 1e3 * float(np.median(e_t)), "mm", 0.02),
            *_times(answers),
        ],
        {"e_R": e_R},
    )


def judge_pair(answers: list[Any]) -> Judged:
    """Pairs that are believed."""
    believed = np.array([a["status"] == Status.CONVERGED.name for a in answers])
    return Judged([share("believed", believed, 1.0), *_times(answers)])


def judge_graph(graph: PoseGraph, answers: list[Any]) -> Judged:
    """SE-Sync's objective, of the tree and in the end, at the worst seed."""
    after = max(_objective(graph, answer) for answer in answers)
    metrics = [Metric("objective", after, "", "down", 0.05 * after), *_times(answers)]
    if "objective_before" in answers[0]:
        before = answers[0]["objective_before"]
        metrics.insert(0, Metric("objective before", before, "", "down"))
    return Judged(metrics)


def _objective(graph: PoseGraph, answer: dict[str, Any]) -> float:
    if "written" not in answer:
        return answer["objective_after"]
    with tempfile.NamedTemporaryFile("w", suffix=".g2o") as file:
        file.write(answer["written"])
        file.flush()
        _, T_world_i = read_g2o_poses(file.name)
    assert T_world_i is not None, "poses are missing"
    return float(chordal_objective(graph, T_world_i))


def _times(answers: list[Any]) -> list[Metric]:
    """As the commands report them, by part."""
    times = [dict(answer["times_s"]) for answer in answers]
    for each in times:  # the demonstration has nothing to read
        if "generate" in each:
            each["read"] = each.pop("generate")
    return [
        Metric(key, float(np.median([t.get(key, 0) for t in times])), "s", "down")
        for key in PARTS
        if any(key in t for t in times)
    ]
