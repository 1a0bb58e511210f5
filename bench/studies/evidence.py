"""How the numbers of the evidence were found, and what it is worth elsewhere.

    python -m bench.studies.evidence collect --out DIR
    python -m bench.studies.evidence report --out DIR

The first registers all pairs in hand and writes a file of JSON lines per kind of data:
of each mode the numbers that evidence is made of, and its errors. A process a kind
(`--only`) spares the memory of the compiler. The second finds the discriminant on the
generated and every other one of the real pairs, checks it on the rest and on kinds that
it was not found on, and draws the reliability of the answers.
"""

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from bench.studies.evidence_modes import NUMBERS, modes_of
from bench.studies.evidence_pairs import CHECKED, GENERATED, KINDS
from bench.studies.reliability import Reliability, draw
from jaxreg.matching import odds


# Keys of a pair.
_KEYS = {"sensors": 3}
# A mode is right within these, in degrees and tolerances, and wrong beyond doubt if one
# of its errors is larger than these.
_RIGHT, _WRONG = (5.0, 1.0), (10.0, 3.0)
_PLOT = Path(__file__).parents[1] / "plots" / "evidence_reliability.png"


class Examples(NamedTuple):
    """Best right and best wrong modes of pairs.

    `numbers` `(n, k)` are log gain, near and firm (in 2D others), `right` `(n,)` 1 or
    0, `pair` `(n,)` the place of the pair in its kind, or its scene.
    """

    numbers: np.ndarray
    right: np.ndarray
    pair: np.ndarray

    def of_half(self, first: int) -> "Examples":
        """Of every other pair."""
        here = self.pair % 2 == first
        return Examples(*(x[here] for x in self))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("collect", "report"))
    parser.add_argument("--out", type=Path, default=Path("bench-out/evidence"))
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    if args.what == "collect":
        for kind in args.only:
            with (args.out / f"{kind}.jsonl").open("w", encoding="utf-8") as file:
                for pair in KINDS[kind](data):
                    for key in range(_KEYS.get(kind, 1)):
                        file.write(json.dumps(modes_of(pair, key)) + "\n")
                        file.flush()
        return
    rows = {kind: list(_read(args.out / f"{kind}.jsonl")) for kind in args.only}
    rows = {kind: found for kind, found in rows.items() if found}
    examples = {kind: examples_of(found) for kind, found in rows.items()}
    for line in (*discriminants(examples), *choices(rows), *reliability(rows)):
        print(line)


def discriminants(examples: dict[str, Examples]) -> Iterator[str]:
    """Found on one half, checked on the other; and without one kind after another."""
    told = {k: x for k, x in examples.items() if k not in CHECKED}
    if not told:
        return
    choose = [x if k in GENERATED else x.of_half(0) for k, x in told.items()]
    check = [x.of_half(1) for k, x in told.items() if k not in GENERATED]
    apart = {k: [x] for k, x in examples.items() if k in CHECKED}
    every, found = list(told.values()), fitted(choose)
    code = odds._GAIN, odds._NEAR, odds._FIRM, -odds._OFFSET
    yield "| | log gain | near | firm | offset | examples | loss | AUC |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, numbers, kinds in (
        ("found on the first half", found, choose),
        ("checked on the second", found, check),
        *((f"checked on {kind}", found, x) for kind, x in apart.items()),
        ("in the code, all", code, every),
        ("in the code, second half", code, check),
        *((f"in the code, {kind}", code, x) for kind, x in apart.items()),
        ("found on all", fitted(every), every),
    ):
        if kinds:
            four = " | ".join(f"{x:.1f}" for x in numbers)
            count = sum(len(x.right) for x in kinds)
            yield f"| {name} | {four} | {count} | {quality(numbers, kinds)} |"
    yield "\n| found without | right, wrong | loss | AUC | right above the best wrong |"
    yield "|---|---|---|---|---|"
    for kind, own in examples.items():
        numbers = fitted([x for k, x in told.items() if k != kind])
        sizes = f"{own.right.sum():.0f}, {(1 - own.right).sum():.0f}"
        above = _above(_scores(numbers, own), own.right)
        yield f"| {kind} | {sizes} | {quality(numbers, [own])} | {above} |"


def fitted(kinds: list[Examples]) -> np.ndarray:
    """`(4,)` weights of the numbers and the offset, by logistic regression.

    Kinds count alike, whatever the number of their examples.
    """
    told, weight = _joined(kinds), _alike(kinds)
    mean, width = told.numbers.mean(axis=0), told.numbers.std(axis=0)
    rows = np.column_stack([(told.numbers - mean) / width, np.ones(len(told.right))])
    sign = 2 * told.right - 1

    def loss(b: np.ndarray) -> float:
        # A slight pull to zero: halves may be separable.
        pull = 0.05 * np.sum(b[:-1] ** 2)
        return weight @ np.logaddexp(0, -sign * (rows @ b)) + pull

    b = minimize(loss, np.zeros(rows.shape[1]), method="BFGS").x
    slope = b[:-1] / width
    return np.append(slope, b[-1] - slope @ mean)


def choices(rows: dict[str, list[dict[str, Any]]]) -> Iterator[str]:
    """Whether the mode of most evidence is right, where one of the modes is."""
    yield ""
    yield "| answers | with a right mode | it is the first | believed | wrong of them |"
    yield "|---|---|---|---|---|"
    total = np.zeros(5, int)
    for kind, found in rows.items():
        right = [[is_right(mode) for mode in row["modes"]] for row in found]
        first = np.array([x[0] for x in right])
        sure = np.array([row["status"] == "CONVERGED" for row in found])
        counts = [len(found), sum(map(any, right)), first.sum(), sure.sum()]
        counts = np.array([*counts, (sure & ~first).sum()])
        total += counts
        yield f"| {kind}: {' | '.join(map(str, counts))} |"
    yield f"| all: {' | '.join(map(str, total))} |\n"


def reliability(rows: dict[str, list[dict[str, Any]]]) -> Iterator[str]:
    """Of the answers: of the evidence alone, and with that of the other modes."""
    told = [row for found in rows.values() for row in found]
    right = np.array([is_right(row["modes"][0]) for row in told], float)
    scores = [np.array([m["log_evidence"] for m in row["modes"]]) for row in told]
    # One of the modes is right, or none of them.
    shared = np.array([np.exp(x[0] - logsumexp(np.append(x, 0))) for x in scores])
    alone = expit([x[0] for x in scores])
    found = {
        "evidence of the answer": Reliability.of(alone, right),
        "with that of other modes": Reliability.of(shared, right),
    }
    yield "| predicted | answers | mean | right |"
    yield "|---|---|---|---|"
    for title, x in found.items():
        yield f"| {title}: error {x.error:.3f} | {x.num.sum()} | | |"
        for k in np.flatnonzero(x.num):
            numbers = f"{x.num[k]} | {x.predicted[k]:.3f} | {x.right[k]:.3f}"
            yield f"| {k / 10:.1f} to {(k + 1) / 10:.1f} | {numbers} |"
    yield "\n| kind | error, evidence of the answer | with that of other modes |"
    yield "|---|---|---|"
    kinds = np.repeat(list(rows), [len(found) for found in rows.values()])
    for kind in rows:
        here = kinds == kind
        both = [Reliability.of(p[here], right[here]).error for p in (alone, shared)]
        yield f"| {kind} | {both[0]:.3f} | {both[1]:.3f} |"
    draw(found, _PLOT)


def _read(path: Path) -> Iterator[dict[str, Any]]:
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            if row["modes"]:
                yield row


def examples_of(
    rows: list[dict[str, Any]], names: tuple[str, ...] = NUMBERS
) -> Examples:
    """The best right and the best wrong mode of each pair, of its first key.

    An answer that slides is neither: its surfaces coincide wherever it slides to.
    """
    numbers, right, pair = [], [], []
    first = [row for row in rows if row.get("key", 0) == 0]
    for at, row in enumerate(first):
        ordered = row["modes"][1:] if _slides(row) else row["modes"]
        for wanted, some in (
            (1.0, [m for m in ordered if is_right(m)]),
            (0.0, [m for m in ordered if is_wrong(m)]),
        ):
            for mode in some[:1]:
                numbers.append([mode[name] for name in names])
                right.append(wanted)
                pair.append(row.get("scene", at))
    numbers = np.reshape(numbers, (len(right), len(names)))
    return Examples(numbers, np.array(right), np.array(pair))


def _slides(row: dict[str, Any]) -> bool:
    """Whether the surfaces that agree in the answer do not hold it."""
    return not row["modes"][0]["holds"]


def is_right(mode: dict[str, float]) -> bool:
    """Within 5 degrees and a tolerance."""
    return mode["degrees"] < _RIGHT[0] and mode["tolerances"] < _RIGHT[1]


def is_wrong(mode: dict[str, float]) -> bool:
    """Beyond doubt."""
    return mode["degrees"] > _WRONG[0] or mode["tolerances"] > _WRONG[1]


def _joined(examples: Any) -> Examples:
    return Examples(*map(np.concatenate, zip(*examples, strict=True)))


def _scores(numbers: Any, told: Examples) -> np.ndarray:
    return told.numbers @ np.asarray(numbers[:-1]) + numbers[-1]


def _alike(kinds: list[Examples]) -> np.ndarray:
    """Weights of one on average, by which kinds count alike."""
    share = np.concatenate([np.full(len(x.right), 1 / len(x.right)) for x in kinds])
    return share / share.mean()


def _auc(scores: np.ndarray, right: np.ndarray) -> str:
    """Share of pairs of a right and a wrong one that are in order."""
    if right.all() or not right.any():
        return "-"
    above = scores[right == 1][:, None] > scores[right == 0]
    return f"{above.mean():.3f}"


def _above(scores: np.ndarray, right: np.ndarray) -> str:
    best = scores[right == 0].max(initial=-np.inf)
    return f"{(scores[right == 1] > best).mean():.2f}" if right.any() else "-"


def quality(numbers: Any, kinds: list[Examples]) -> str:
    """Loss and AUC of weights, two cells of a table."""
    told = _joined(kinds)
    scores = _scores(numbers, told)
    loss = _alike(kinds) @ np.logaddexp(0, -(2 * told.right - 1) * scores)
    return f"{loss / len(scores):.3f} | {_auc(scores, told.right)}"


if __name__ == "__main__":
    main()
