"""Floors of a building in 3D, as a lidar that spins sees them.

The rooms of `bench.studies.flat_scenes` with a floor, a ceiling and furniture of some
height: walls, boxes and nothing else.
"""

from typing import NamedTuple

import numpy as np

from bench.studies.flat_scenes import Floor, Lidar


_TALL, _HEIGHTS = 2.6, (0.45, 0.75, 1.1, 1.9)
#: Elevations of the rays of a lidar that spins, in radians.
SPINS = np.deg2rad(np.linspace(-25, 15, 32))


class Building(NamedTuple):
    """A floor, and the heights of its furniture, in metres."""

    floor: Floor
    height: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Building":
        """With furniture as high as seats, tables, counters or cupboards."""
        floor = Floor.drawn(rng)
        return cls(floor, rng.choice(_HEIGHTS, len(floor.furniture)))

    def poses(self, num: int, rng: np.random.Generator) -> np.ndarray:
        """`(n, 4, 4)` of a level scanner that is carried from room to room."""
        T = np.tile(np.eye(4), (num, 1, 1))
        flat = self.floor.poses(num, rng)
        T[:, :2, :2], T[:, :2, 3] = flat[:, :2, :2], flat[:, :2, 2]
        T[:, 2, 3] = rng.uniform(1.1, 1.7, num)
        return T

    def scan(
        self, T_world_scan: np.ndarray, rings: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """`(n, 3)` float32, what a scanner sees about itself."""
        flat = T_world_scan[np.ix_((0, 1, 3), (0, 1, 3))]
        lidar, eye = Lidar(reach=15.0, noise=0.005), T_world_scan[2, 3]
        own, wall = lidar.lengths(self.floor.walls, flat)
        boxes = len(self.floor.furniture)
        tops = np.full(wall.shape[1], _TALL)
        tops[wall.shape[1] - 4 * boxes :] = np.repeat(self.height, 4)
        ray, points = own @ flat[:2, :2].T, []
        for up in rings:
            slope = np.tan(up)
            with np.errstate(invalid="ignore"):
                met = eye + wall * slope <= tops
            across = np.min(np.where(met, wall, np.inf), axis=1)
            flat_at = (_TALL - eye if up > 0 else -eye) / (slope if slope else np.inf)
            across = np.minimum(across, flat_at if flat_at > 0 else np.inf)
            if up < 0:
                across = self._tops(flat[:2, 2], ray, eye, slope, across)
            length = across / np.cos(up)
            seen = length < lidar.reach
            told = length[seen] + rng.normal(0, lidar.noise, seen.sum())
            rise = np.full(len(told), np.sin(up))
            points.append(told[:, None] * np.c_[np.cos(up) * own[seen], rise])
        return np.concatenate(points).astype(np.float32)

    def _tops(
        self,
        place: np.ndarray,
        ray: np.ndarray,
        eye: float,
        slope: float,
        across: np.ndarray,
    ) -> np.ndarray:
        """How far rays go that meet the upper side of furniture before."""
        for thing, height in zip(self.floor.furniture, self.height, strict=True):
            if height >= eye:
                continue
            at = (height - eye) / slope
            turn = np.exp(-1j * thing[4]) * ((place + at * ray - thing[:2]) @ (1, 1j))
            over = (np.abs(turn.real) < thing[2]) & (np.abs(turn.imag) < thing[3])
            across = np.where(over & (at < across), at, across)
        return across
