"""Pairs in 2D to study the evidence on, all of them generated."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from bench.studies.flat_scenes import Floor, Lidar, outline, pose, sampled, wood


#: Points of a map at most.
MOST = 4096
_FIELDS, _NOISES = (2 * np.pi, 1.5 * np.pi, np.pi), (0.005, 0.01, 0.03)


class Pair(NamedTuple):
    """Two clouds with the truth; None where they share no scene.

    `tolerance`: of the translation at the source's centroid, beside 5 degrees.
    """

    scene: int
    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray | None
    tolerance: float

    def errors(self, T: np.ndarray) -> tuple[float, float]:
        """Degrees and tolerances; infinite of strangers."""
        if self.T_target_source is None:
            return np.inf, np.inf
        off = np.linalg.inv(self.T_target_source) @ T
        middle = self.source.mean(axis=0)
        shift = off[:2, :2] @ middle + off[:2, 2] - middle
        degrees = abs(np.rad2deg(np.arctan2(off[1, 0], off[0, 0])))
        return degrees, float(np.linalg.norm(shift)) / self.tolerance


def floors(num: int = 24) -> Iterator[Pair]:
    """Scans of rooms: nine pairs of near ones of a floor, and four of any."""
    for scene in range(num):
        rng = np.random.default_rng(scene)
        floor, lidar = Floor.drawn(rng), _lidar(scene)
        T = floor.poses(30, rng)
        scans = [lidar.scan(floor.walls, x, rng) for x in T]
        for k in range(13):
            i = rng.integers(27)
            j = i + rng.integers(1, 4) if k < 9 else (i + rng.integers(4, 27)) % 30
            yield Pair(scene, scans[j], scans[i], np.linalg.inv(T[i]) @ T[j], 0.3)


def woods(num: int = 16) -> Iterator[Pair]:
    """Scans among trunks and bushes, one to twelve metres apart."""
    for scene in range(num):
        rng = np.random.default_rng(1000 + scene)
        things = wood(rng)
        lidar = Lidar(720, _FIELDS[scene // 2 % 2], 20.0, 0.02)
        for k in range(12):
            place = rng.uniform(8, 32, 2)
            both = place, place + rng.normal(0, (1, 3, 6, 12)[k % 4], 2)
            T = [pose(x, rng.uniform(-np.pi, np.pi)) for x in both]
            scans = [lidar.scan(things, x, rng) for x in T]
            if min(map(len, scans)) >= 60:
                yield Pair(scene, scans[1], scans[0], np.linalg.inv(T[0]) @ T[1], 0.5)


def outlines(num: int = 120) -> Iterator[Pair]:
    """Closed curves and parts of them, every fourth of two different things."""
    for scene in range(num):
        rng = np.random.default_rng(2000 + scene)
        share, noise = (1, 0.75, 0.5)[scene // 6 % 3], (0, 0.01, 0.03)[scene // 2 % 3]
        same, thing = scene // 2 % 4 < 3, rng.integers(1 << 30)
        angle = [
            np.linspace(0, 2 * np.pi, n, endpoint=False)
            for n in rng.integers(80, 400, 2)
        ]
        start = rng.uniform(0, 2 * np.pi)
        part = (angle[1] - start) % (2 * np.pi) < share * 2 * np.pi
        source, target = (
            outline(np.random.default_rng(seed), a)
            for seed, a in ((thing + (not same), angle[1][part]), (thing, angle[0]))
        )
        T = pose(rng.normal(0, 1, 2), rng.uniform(-np.pi, np.pi))
        source, target = (x + rng.normal(0, noise, x.shape) for x in (source, target))
        source = (source - T[:2, 2]) @ T[:2, :2]
        yield Pair(scene, source, target, T if same else None, 0.1)


def maps(num: int = 20) -> Iterator[Pair]:
    """Scans on the map of a floor, every other time of another floor."""
    for scene in range(num):
        rng = np.random.default_rng(3000 + scene)
        floor, other = Floor.drawn(rng), Floor.drawn(rng)
        same, lidar = scene // 2 % 2 == 0, _lidar(scene)
        plan = sampled((floor if same else other).walls, 0.06, rng)
        plan = plan[rng.permutation(len(plan))[:MOST]]
        for T in floor.poses(6, rng):
            scan = lidar.scan(floor.walls, T, rng)
            yield Pair(scene, scan, plan, T if same else None, 0.3)


def strangers(num: int = 80) -> Iterator[Pair]:
    """Scans of different floors."""
    for scene in range(num):
        rng = np.random.default_rng(4000 + scene)
        scans = []
        for floor in (Floor.drawn(rng), Floor.drawn(rng)):
            T = floor.poses(12, rng)[rng.integers(12)]
            scans.append(_lidar(scene).scan(floor.walls, T, rng))
        yield Pair(scene, scans[0], scans[1], None, 1.0)


def _lidar(scene: int) -> Lidar:
    return Lidar(field=_FIELDS[scene // 2 % 3], noise=_NOISES[scene // 6 % 3])


#: By name: pairs, and whether they are told to be seen from their origins.
KINDS: dict[str, tuple[Callable[[], Iterator[Pair]], bool]] = {
    "floors": (floors, False),
    "woods": (woods, False),
    "outlines": (outlines, False),
    "maps": (maps, False),
    "strangers": (strangers, False),
    "floors, viewed": (floors, True),
    "woods, viewed": (woods, True),
    "strangers, viewed": (strangers, True),
}
