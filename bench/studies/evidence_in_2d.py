"""How the numbers of the evidence were found in 2D, and what it is worth elsewhere.

    python -m bench.studies.evidence_in_2d collect --out DIR
    python -m bench.studies.evidence_in_2d report --out DIR

As `bench.studies.evidence`: the first registers pairs of generated scenes and writes a
file of JSON lines per kind, also of the same pairs where it is known from where they
were taken; the second fits the discriminant on pairs of even numbers and checks it on
those of odd ones, whose scenes are others.
"""

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from bench.studies.evidence import examples_of, fitted, is_right, quality
from bench.studies.flat_pairs import KINDS, MOST, Pair
from jaxreg import ParticleFilter, Status
from jaxreg.matching import odds
from jaxreg.neighbours import BruteForce
from jaxreg.particle.conclude import Pair as Prepared
from jaxreg.registrar import GivenPair, prepare_pair


#: What evidence is made of in 2D.
NUMBERS = "near", "firm", "seen", "viewed"
# Rows that clouds are padded to.
_SIZES = 1024, MOST


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("collect", "report"))
    parser.add_argument("--out", type=Path, default=Path("bench-out/evidence_in_2d"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what == "collect":
        for kind, (pairs, viewed) in KINDS.items():
            with (args.out / f"{kind}.jsonl").open("w", encoding="utf-8") as file:
                for pair in pairs():
                    file.write(json.dumps(modes_of(pair, viewed)) + "\n")
        return
    rows = {}
    for kind in KINDS:
        lines = (args.out / f"{kind}.jsonl").read_text(encoding="utf-8").splitlines()
        rows[kind] = [row for row in map(json.loads, lines) if row["modes"]]
    for line in (*discriminants(rows), *answers(rows)):
        print(line)


def discriminants(rows: dict[str, list[dict[str, Any]]]) -> Iterator[str]:
    """Found on scenes of even numbers, checked on the others."""
    told = {kind: examples_of(found, NUMBERS) for kind, found in rows.items()}
    halves = [[x.of_half(k) for x in told.values()] for k in (0, 1)]
    found = fitted(halves[0])
    code = odds._NEAR_2D, odds._FIRM_2D, odds._SEEN_2D, odds._VIEWED_2D
    code = *code, -odds._OFFSET_2D
    yield "| | near | firm | seen | viewed | offset | loss | AUC |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, numbers, some in (
        ("found on even scenes", found, halves[0]),
        ("checked on odd ones", found, halves[1]),
        ("in the code, odd ones", code, halves[1]),
        ("found on all", fitted(list(told.values())), list(told.values())),
    ):
        five = " | ".join(f"{x:.1f}" for x in numbers)
        yield f"| {name} | {five} | {quality(numbers, some)} |"
    yield "\n| in the code, odd scenes of | right, wrong | loss | AUC |"
    yield "|---|---|---|---|"
    for kind, x in zip(told, halves[1], strict=True):
        sizes = f"{x.right.sum():.0f}, {(1 - x.right).sum():.0f}"
        yield f"| {kind} | {sizes} | {quality(code, [x])} |"


def answers(rows: dict[str, list[dict[str, Any]]]) -> Iterator[str]:
    """What is believed, of all scenes."""
    yield "\n| answers | with a right mode | believed and right | believed and wrong |"
    yield "|---|---|---|---|"
    for kind, found in rows.items():
        some = sum(any(map(is_right, row["modes"])) for row in found)
        sure = [row["modes"][0] for row in found if row["status"] == "CONVERGED"]
        right = sum(map(is_right, sure))
        yield f"| {kind}: {len(found)} | {some} | {right} | {len(sure) - right} |"


def modes_of(pair: Pair, viewed: bool) -> dict[str, Any]:
    """What `register` finds, with the numbers of the modes and their errors."""
    clouds, num = [], next(n for n in _SIZES if n >= max(map(len, pair[1:3])))
    for points in (pair.source, pair.target):
        more = num - len(points)
        clouds.append(np.pad(points.astype(np.float32), ((0, more), (0, 0))))
        clouds.append(np.arange(num) < len(points))
    T, status, numbers = _searched(*clouds, viewed=viewed)
    names = "log_evidence", "weight", "holds", *NUMBERS
    modes = []
    for x, *row in zip(np.asarray(T, float), *map(np.asarray, numbers), strict=True):
        degrees, tolerances = pair.errors(x)
        told = dict(zip(names, map(float, row), strict=True))
        if told["weight"] > 0:
            modes.append(told | {"degrees": degrees, "tolerances": tolerances})
    return {"scene": pair.scene, "status": Status(int(status)).name, "modes": modes}


@partial(jax.jit, static_argnames="viewed")
def _searched(
    source: Array,
    source_mask: Array,
    target: Array,
    target_mask: Array,
    *,
    viewed: bool,
) -> tuple[Array, Array, tuple[Array, ...]]:
    eyes = jnp.zeros((2, source.shape[1])) if viewed else None
    pair = GivenPair(source, target, source_mask, target_mask, eyes)
    ready, key = prepare_pair(ParticleFilter(), pair), jax.random.key(0)
    found = ready.method.solve(ready.source, ready.target, None, key)
    T = found.modes.T_target_source
    index = BruteForce.build(ready.target.points, ready.target.mask)
    prepared = Prepared.of(ready.source, ready.target, index)
    witness = prepared.judged.exact.witness

    def numbers(T: Array) -> tuple[Array, ...]:
        there, back = witness._ways(T[None], jnp.ones(1, bool))
        said = witness._said(there, back)
        told = there.grip.holds, said.near, said.firm, said.share_seen
        return *(x[0] for x in told), said.viewed

    told = found.modes.log_evidence, found.modes.weight, *lax.map(numbers, T)
    return jax.vmap(ready.frames.leave)(T), found.status, told


if __name__ == "__main__":
    main()
