"""Pairs without a guess and with known truth: turned horses and real scans."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bench.workloads.filter_data import Trials
from jaxreg.io.poses.stanford import read_conf


SCAN_SETS = {
    "stanford_bunny": ("bunny_scans.npz", "bun.conf"),
    "stanford_dragon": ("dragonStandRight_scans.npz", "dragonStandRight.conf"),
}
# Overlap at the truth, from above.
BANDS = {">= 0.3": (0.3, 1.1), "0.1-0.3": (0.1, 0.3), "< 0.1": (-1.0, 0.1)}


class ScanPairs(NamedTuple):
    """Real scans and every pair of them, the later one on the earlier.

    `scans` are `(n_i, 3)` float32 in metres, `T_world_i` `(v, 4, 4)`, `pairs` `(p, 2)`
    target and source, `overlap` `(p,)` at the truth, the lesser of both directions.
    """

    name: str
    scans: list[np.ndarray]
    T_world_i: np.ndarray
    pairs: np.ndarray
    overlap: np.ndarray

    def truth(self, pair: int) -> np.ndarray:
        """`T_target_source` of a pair."""
        target, source = self.pairs[pair]
        return np.linalg.inv(self.T_world_i[target]) @ self.T_world_i[source]

    def errors(self, pair: int, T: np.ndarray) -> tuple[float, float]:
        """Degrees, and millimetres at the centroid of the source."""
        truth = self.truth(pair)
        chord = np.linalg.norm((T - truth)[:3, :3]) / np.sqrt(8)
        centre = [*self.scans[self.pairs[pair][1]].mean(0, dtype=float), 1]
        degrees = np.degrees(2 * np.arcsin(min(chord, 1)))
        return float(degrees), float(1e3 * np.linalg.norm((T - truth)[:3] @ centre))

    def correct(self, pair: int, T: np.ndarray) -> bool:
        """Within 5 degrees and 5 mm."""
        degrees, mm = self.errors(pair, T)
        return degrees < 5 and mm < 5


def scan_pairs(folder: Path, name: str) -> ScanPairs:
    """All pairs of one of `SCAN_SETS`."""
    file, conf = SCAN_SETS[name]
    poses = read_conf(folder / name / conf)
    with np.load(folder / name / file) as scans:
        points = [scans[key] for key in poses]
    table = np.genfromtxt(
        folder / name / "overlap_1mm.csv", delimiter=",", skip_header=1
    )
    share = np.minimum(table[:, 1:], table[:, 1:].T)
    pairs = np.argwhere(np.triu(np.ones_like(share), 1))
    return ScanPairs(name, points, np.array([*poses.values()]), pairs, share[*pairs.T])


def so3(num: int, noise: float, model: np.ndarray, seed: int = 0) -> Trials:
    """Table 1's protocol with rotations uniform over SO(3).

    Args:
        num: trials.
        noise: share of the 400 points that N(0, 40) about the middle replaces.
        model: `(8000, 3)`: the first half is the target, the data are of the others.
        seed: of the random numbers.
    """
    return _turned(num, noise, model, seed, half=False)


def half(num: int, noise: float, model: np.ndarray, seed: int = 0) -> Trials:
    """The same with one side of a random plane through the middle as the source."""
    return _turned(num, noise, model, seed, half=True)


def _turned(
    num: int, noise: float, model: np.ndarray, seed: int, *, half: bool
) -> Trials:
    rng = np.random.default_rng([seed, round(100 * noise), half])
    target, pool = model[:4000], model[4000:]
    points, motions = [], []
    for _ in range(num):
        seen = pool @ rng.standard_normal(3) > 0 if half else np.ones(len(pool), bool)
        few = rng.permutation(pool[seen])[:400]
        few[: round(400 * noise)] = rng.normal(0, 40, (round(400 * noise), 3))
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T[:3, 3] = rng.normal(0, 45, 3)
        points.append(rng.permutation(few) @ T[:3, :3].T + T[:3, 3])
        motions.append(T)
    return Trials(
        np.array(points, np.float32),
        target.astype(np.float32),
        np.linalg.inv(motions),
        10.0,
        5.0,
        np.eye(3)[None],
    )
