"""All pairs of real scans without a guess: what is found, and what is believed."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from bench.case import Case, Judged, Method, Options, Solve
from bench.peers.global_pairs import Peer, scan_peers
from bench.records import Metric, error, share
from bench.workloads.global_data import BANDS, SCAN_SETS, ScanPairs, scan_pairs
from bench.workloads.local_pairs import written_out
from bench.workloads.prepared_scans import Own
from jaxreg import Status
from jaxreg.particle import AbstractSearch, MultiStart, ParticleFilter


#: Share of points that meet, above which a user of features believes a pair.
BELIEVED = 0.3
#: Pose, score, and whether the method believes it.
Answer = tuple[np.ndarray, float, bool]


def cases(options: Options) -> Iterator[Case]:
    """A case per set of scans that is there."""
    for name in SCAN_SETS:
        if not (options.data / name).is_dir():
            continue
        data = scan_pairs(options.data, name)
        searches: dict[str, AbstractSearch] = {
            "jaxreg, prepared scans": ParticleFilter(),
            "jaxreg MultiStart, prepared scans": MultiStart(),
        }
        methods = [
            Method(label, "jaxreg", written_out(x), prepare=partial(own, x, data))
            for label, x in searches.items()
        ]
        methods += [
            Method(label, library, f"{x}", prepare=partial(by_peer, x, data))
            for label, (library, x) in scan_peers().items()
        ]
        pairs = [(t, s, k) for k, (t, s) in enumerate(data.pairs.tolist())]
        yield Case(
            name=name,
            data=f"{name}, {len(data.scans)} scans",
            methods=methods,
            trials=pairs,
            judge=partial(judge, data),
            reference="Open3D FPFH + RANSAC",
        )


def own(method: AbstractSearch, data: ScanPairs) -> Solve:
    """Scans prepared, and the search between two of them."""
    search = Own(method, data)

    def solve(target: int, source: int, seed: int) -> Answer:
        T, found = search.solve(source, target, seed)
        believed = int(found.status) == Status.CONVERGED
        return T, float(found.overlap), believed

    return solve


def by_peer(peer: Peer, data: ScanPairs) -> Solve:
    """The same of a peer."""
    scans = [peer.prepare(scan) for scan in data.scans]

    def solve(target: int, source: int, seed: int) -> Answer:
        T, score = peer.solve(scans[source], scans[target], seed)
        return np.asarray(T), score, score > BELIEVED

    return solve


def judge(data: ScanPairs, answers: list[Any]) -> Judged:
    """Right pairs by their overlap at the truth, and beliefs that are wrong."""
    right = np.array([data.correct(k, T) for k, (T, _, _) in enumerate(answers)])
    believed = np.array([b for _, _, b in answers])
    score = np.array([s for _, s, _ in answers])
    # What a user could believe without an error, by whatever threshold is best.
    above = float((score[right] > score[~right].max(initial=0)).sum())
    both = np.array([data.errors(k, T) for k, (T, _, _) in enumerate(answers)])
    metrics = []
    for band, (low, high) in BANDS.items():
        here = (data.overlap >= low) & (data.overlap < high)
        slack = 100 * max(1.0, 0.05 * here.sum()) / here.sum() + 1e-6
        metrics.append(share(f"right, overlap {band}", right[here], slack))
    metrics += [
        Metric("right above any wrong", above, "pairs", "up", 3.0),
        Metric("believed", float(believed.sum()), "pairs", "up", 3.0),
        Metric(
            "believed wrongly", float((believed & ~right).sum()), "pairs", "down", 1.0
        ),
        error("e_rot", float(np.median(both[right, 0])), "deg", 0.02),
        error("e_trans", float(np.median(both[right, 1])), "mm", 0.02),
    ]
    samples = {"e_rot": both[:, 0].tolist(), "overlap": data.overlap.tolist()}
    return Judged(metrics, samples | {"right": right.astype(float).tolist()})
