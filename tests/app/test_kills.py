"""A run that is killed at any moment is gone on with to the same result."""

import json
import os
import subprocess
import sys

import pytest


if not hasattr(os, "fork"):
    pytest.skip("children are forked", allow_module_level=True)

# A solver that registers a pair at a time and believes those that it is given.
CODE = """
import dataclasses, json, tempfile, warnings
from pathlib import Path
from typing import Any

import jax, pytest
import jax.numpy as jnp
import jaxreg
from jaxreg.app import result
from tests.app import kills
from tests.app.cli.stand_ins import POSES, fake_reconstruct, save_scans

# Importing starts no backend of JAX, whose threads would be missing in a child.
assert not jax._src.xla_bridge._backends
fake_reconstruct(pytest.MonkeyPatch(), POSES, [True] * 3)
known = jaxreg.reconstruct

def by_pairs(scans: Any, *, on_pairs: Any, previous: Any = None, **options: Any) -> Any:
    sol = known(scans, **options)
    found = sol.motions
    start = 0 if previous is None else len(previous.pairs)
    for e in range(start, len(found.pairs)):
        on_pairs(jax.tree.map(lambda x: x[e : e + 1], found))
    if start:
        both = lambda old, new: jnp.concatenate([old, new[start:]])
        found = jax.tree.map(both, previous, found)
    graph = jaxreg.PoseGraph.from_edges(found.pairs, found.T_i_j[:, 0])
    return dataclasses.replace(sol, motions=found, graph=graph)

jaxreg.reconstruct = by_pairs
warnings.simplefilter("ignore")
with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    save_scans(folder)
    words = ["multiview", *(f"../s{k}.npy" for k in range(3)), "--resume", "--quiet"]
    alone = kills.run(folder / "alone", words, lambda: None)
    expected = kills.outcome(folder / "alone")
    ends = []
    for moment in MOMENTS:
        place = folder / f"killed{moment}"
        killed = kills.run(place, words, lambda: kills.die_at(moment))
        again = kills.run(place, words, lambda: None)
        ends.append([killed, again, kills.outcome(place) == expected])
    full = kills.run(folder / "full", words, lambda: kills.fill_disk(20_000))
    left = sorted(p.name for p in (folder / "full" / "jaxreg-out").iterdir())
    again = kills.run(folder / "full", words, lambda: None)
    same = kills.outcome(folder / "full") == expected
found = {"alone": [alone, expected[1]], "killed": ends}
print(json.dumps(found | {"full": [full, left, again, same]}))
"""


def test_killed_runs_and_full_disks():
    code = CODE.replace("MOMENTS", str([2, 5, 9, 13]))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    found = json.loads(done.stdout)
    names = ["figure.png", "graph.g2o", "merged.ply", "poses.tum", "report.html"]
    assert found["alone"] == [0, [*names, "result.json"]]
    assert found["killed"] == [[-9, 0, True]] * 4
    assert found["full"] == [2, ["pairs.jsonl"], 0, True]
    assert done.stderr == "jaxreg: File too large; no results were written.\n"
