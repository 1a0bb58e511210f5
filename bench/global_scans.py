"""All pairs of real scans without a guess: what is found, and what is believed.

Correct is within 5 degrees and 5 mm (at the source's centroid). A pair that is found
wrong is searched once more from its truth, to tell why: where the truth scores higher
it was not reached (`search`), else the score prefers another pose (`score`).
"""

from functools import partial
from pathlib import Path

import numpy as np

from bench.global_data import BANDS, SCAN_SETS, ScanPairs, scan_pairs
from bench.global_prepared import Own, Result, run_own, run_register
from bench.peers_global import Features, missing, scan_peers
from bench.timing import quartiles, timed
from jaxreg.particle import AbstractSearch, MultiStart, ParticleFilter


def run_features(peer: Features, data: ScanPairs) -> tuple[list[Result], float]:
    """Every pair by prepared scans, and seconds that the preparation of a scan took."""
    took = timed(lambda: [peer.prepare(scan) for scan in data.scans])
    results = []
    for pair, (target, source) in enumerate(data.pairs):
        solve = partial(peer.solve, took.value[source], took.value[target], pair)
        call = timed(solve)
        T, score = call.value
        results.append(Result(T, score, False, call.cpu))
    return results, took.cpu / len(data.scans)


def row_of(name: str, data: ScanPairs, found: list[Result]) -> dict:
    """What is told of a method."""
    right = np.array([data.correct(k, r.T_target_source) for k, r in enumerate(found)])
    score = np.array([r.score for r in found])
    believed = np.array([r.believed for r in found])
    cpu = quartiles([r.seconds for r in found])
    row = {"experiment": data.name, "method": name, "pair_s": cpu[1]}
    for band, (low, high) in BANDS.items():
        here = (data.overlap >= low) & (data.overlap < high)
        row |= {f"right {band}": int(right[here].sum()), f"of {band}": int(here.sum())}
    return row | {
        "pair_s_quartiles": [cpu[0], cpu[2]],
        "worst_right": float(score[right].min(initial=1)),
        "best_wrong": float(score[~right].max(initial=0)),
        "right_above_wrong": int((score[right] > score[~right].max(initial=0)).sum()),
        "believed_right": int((believed & right).sum()),
        "believed_wrong": int((believed & ~right).sum()),
        "wrong": np.flatnonzero(~right).tolist(),
    }


_HEAD = (
    f"{'':28s}" + "".join(f"{band:>9s}" for band in BANDS) + f"{'s/pair':>8s}"
    f"{'s/scan':>8s}{'worst right':>13s}{'best wrong':>12s}{'right above it':>16s}"
    f"{'believed: right':>17s}{'wrong':>7s}"
)


def print_row(row: dict) -> None:
    """One line of the table."""
    counts = [f"{row[f'right {band}']}/{row[f'of {band}']}" for band in BANDS]
    text = "".join(f"{count:>9s}" for count in counts)
    scan = f"{row['scan_s']:8.3f}" if "scan_s" in row else f"{'':8s}"
    print(
        f"{row['method']:28s}{text}{row['pair_s']:8.3f}{scan}{row['worst_right']:13.3f}"
        f"{row['best_wrong']:12.3f}{row['right_above_wrong']:16d}"
        + (
            f"{row['believed_right']:17d}{row['believed_wrong']:7d}"
            if row["believed_right"] + row["believed_wrong"]
            else ""
        ),
        flush=True,
    )


def print_wrong(own: Own, data: ScanPairs, found: list[Result]) -> list[dict]:
    """Why each wrong pair of some overlap is wrong."""
    rows = []
    print("  wrong   target source  overlap  degrees      mm   score  at the truth")
    for pair in np.argsort(data.overlap)[::-1].tolist():
        result = found[pair]
        if data.overlap[pair] < 0.1 or data.correct(pair, result.T_target_source):
            continue
        target, source = data.pairs[pair].tolist()
        degrees, mm = data.errors(pair, result.T_target_source)
        true = own.at(source, target, data.truth(pair))
        why = "search" if true > result.score else "score"
        rows.append({"experiment": f"{data.name}, wrong", "why": why, "at_truth": true})
        rows[-1] |= {"pair": [target, source], "score": result.score, "mm": mm}
        print(
            f"  {why:9s}{target:5d}{source:7d}{data.overlap[pair]:9.3f}{degrees:9.1f}"
            f"{mm:8.1f}{result.score:8.3f}{true:14.3f}",
            flush=True,
        )
    return rows


def compare(folder: Path, names: list[str] | None) -> list[dict]:
    """Prints a table for each set of scans that is there."""
    rows: list[dict] = []
    for name in SCAN_SETS:
        if not (folder / name).is_dir():
            print(f"\nno {folder / name}")
            continue
        data = scan_pairs(folder, name)
        print(f"\n{name}: {len(data.pairs)} pairs; right by overlap\n{_HEAD}")
        rows += _table(data, names)
    return rows


def _table(data: ScanPairs, names: list[str] | None) -> list[dict]:
    def wanted(name: str) -> bool:
        return not names or any(n in name for n in names)

    rows = []
    own: dict[str, AbstractSearch] = {
        "ParticleFilter(), prepared": ParticleFilter(),
        "MultiStart(), prepared": MultiStart(),
    }
    for name, method in own.items():
        if wanted(name):
            search = Own(method, data)
            found = run_own(search, data)
            rows.append(row_of(name, data, found) | {"scan_s": search.prepare_s})
            print_row(rows[-1])
            rows += print_wrong(search, data, found)
    if wanted("register()"):
        rows.append(row_of("register()", data, run_register(data)))
        print_row(rows[-1])
    for name, peer in scan_peers().items():
        if why := missing("open3d"):
            print(f"{name}: {why}")
        elif wanted(name):
            found, scan_s = run_features(peer, data)
            rows.append(row_of(name, data, found) | {"scan_s": scan_s})
            print_row(rows[-1])
    return rows
