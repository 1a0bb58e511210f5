"""One table for many pairs: a line per pair, a column per method."""

from collections.abc import Iterator

import numpy as np

from bench.records import Row


#: What the cells mean.
LEGEND = (
    "A letter per key: R right, w wrong, + believed, - not. Then medians of the errors "
    "in degrees and in the unit of the data, and CPU seconds of a call; log evidence "
    "and overlap are those of {}."
)


def pair_table(rows: list[Row]) -> Iterator[str]:
    """Of rows whose `samples` tell what is right and believed; sums at the end."""
    methods = list(dict.fromkeys(row.key.method for row in rows))
    pairs = list(dict.fromkeys(row.key.case for row in rows))
    at = {(row.key.case, row.key.method): row for row in rows}
    own = next((r.key.method for r in rows if r.library == "jaxreg"), methods[0])
    cores = "one core" if rows[0].threads == 1 else f"{rows[0].threads} cores"
    runs = ", ".join(dict.fromkeys(row.run for row in rows))
    yield f"{LEGEND.format(own)} {cores.capitalize()}; run {runs}.\n"
    told = {"log_evidence": "log evidence", "overlap": "overlap"}
    yield f"| pair | {' | '.join([*methods, *told.values()])} |"
    yield "|---" * (1 + len(methods) + len(told)) + "|"
    for pair in pairs:
        cells = [_cell(at.get((pair, method))) for method in methods]
        first = at.get((pair, own))
        cells += [_number(first and first.value(key)) for key in told]
        yield f"| {pair} | {' | '.join(cells)} |"
    for name, text in _SUMS.items():
        sums = [_sum(name, [r for r in rows if r.key.method == m]) for m in methods]
        yield f"| {text} | {' | '.join(sums)} |{' |' * len(told)}"
    yield ""


_SUMS = {
    "right": "right",
    "both": "right and believed",
    "wrong": "wrong and believed",
    "time": "median CPU seconds",
}


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    if row.status != "ok":
        return row.status
    right, believed = row.samples["right"], row.samples["believed"]
    letters = "".join(
        ("R" if r else "w") + ("+" if b else "-")
        for r, b in zip(right, believed, strict=True)
    )
    numbers = [row.value(key) for key in ("e_rot", "e_trans")]
    seconds = (row.value("cpu_ms") or 0) / 1e3
    return f"{letters} {', '.join(map(_number, numbers))}; {seconds:.2g} s"


def _sum(name: str, rows: list[Row]) -> str:
    """Of a column."""
    rows = [row for row in rows if row.status == "ok"]
    if not rows:
        return ""
    if name == "time":
        return f"{np.median([row.value('cpu_ms') or 0 for row in rows]) / 1e3:.2g}"
    right, believed = (
        np.concatenate([row.samples[key] for row in rows]).astype(bool)
        for key in ("right", "believed")
    )
    found = {"right": right, "both": right & believed, "wrong": believed & ~right}
    return f"{found[name].sum()} of {len(right)}"


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"
