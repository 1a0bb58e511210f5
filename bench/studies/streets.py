"""Simulated streets, as a lidar that spins sees them from two places.

Houses in two rows with gaps between them, parked cars, poles and crowns of trees that
let most rays through; rays of some rings, range noise, lost returns. The street, the
scanner and the way between both places follow from a seed.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


# Half the length of a street, ranges of a scanner, and its height, in metres.
_HALF, _NEAREST, _FARTHEST, _EYE = 120.0, 1.5, 80.0, 1.8
#: Translation error that counts as right, in metres.
TOLERANCE = 0.6


class Street(NamedTuple):
    """What stands in it, in metres; the ground is z = 0.

    Attributes:
        low, high: `(b, 3)` corners of boxes.
        poles: `(p, 3)` x, y and radius.
        crowns: `(c, 4)` middle and radius of balls.
    """

    low: np.ndarray
    high: np.ndarray
    poles: np.ndarray
    crowns: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Street":
        """Houses, then cars, then poles of which some carry crowns."""
        half = rng.uniform(3, 7)
        boxes = [box for side in (-1, 1) for box in _houses(rng, side, half)]
        for _ in range(rng.integers(8, 25)):
            x, y = rng.uniform(-50, 50), rng.choice([-1, 1]) * (half - 1.2)
            boxes.append(([x - 2.1, y - 0.85, 0.15], [x + 2.1, y + 0.85, 1.5]))
        y = rng.choice([-1, 1], 20) * (half - 0.3)
        feet = np.stack([rng.uniform(-60, 60, 20), y, rng.uniform(0.08, 0.25, 20)], 1)
        crowns = [
            feet[:8, :2],
            rng.uniform(3, 4.5, (8, 1)),
            rng.uniform(1, 2.2, (8, 1)),
        ]
        low, high = (np.array(corner) for corner in zip(*boxes, strict=True))
        return cls(low, high, feet, np.concatenate(crowns, axis=1))

    def ranges(
        self, eye: np.ndarray, rays: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """`(n,)` to the first thing that unit rays `(n, 3)` from an eye meet."""
        down = np.minimum(rays[:, 2], -1e-9)
        found = np.where(rays[:, 2] < 0, -eye[2] / down, np.inf)
        inverse = 1 / np.where(np.abs(rays) < 1e-12, 1e-12, rays)
        for low, high in zip(self.low, self.high, strict=True):
            a, b = (low - eye) * inverse, (high - eye) * inverse
            enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
            met = (enter <= leave) & (enter > 0)
            found = np.where(met, np.minimum(found, enter), found)
        for x, y, radius in self.poles:
            t = _round(eye[:2] - (x, y), rays[:, :2], radius)
            z = eye[2] + np.where(np.isfinite(t), t, 0) * rays[:, 2]
            found = np.where((z > 0) & (z < 6), np.minimum(found, t), found)
        for *middle, radius in self.crowns:
            # Leaves: some rays miss them all, some go in.
            t = _round(eye - middle, rays, radius) + rng.exponential(0.4, len(rays))
            hit = rng.random(len(rays)) < 0.6
            found = np.where(hit, np.minimum(found, t), found)
        return found


def street_pair(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source and target, `(n, 3)` and `(m, 3)` float32, and `T_target_source`.

    Frames are those of the scanner; the source is turned at random.
    """
    rng = np.random.default_rng(seed)
    street = Street.drawn(rng)
    rays, noise = _scanner(rng), rng.uniform(0.01, 0.04)
    clouds, poses = [], []
    for x in (0, rng.uniform(1, 15)):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        T[:3, 3] = x, rng.uniform(-1, 1), _EYE
        r = street.ranges(T[:3, 3], rays @ T[:3, :3].T, rng)
        seen = (r > _NEAREST) & (r < _FARTHEST) & (rng.random(len(r)) < 0.97)
        r = r[seen] + rng.normal(0, noise, seen.sum())
        clouds.append(rays[seen] * r[:, None])
        poses.append(T)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(rng=rng).as_matrix()
    source = clouds[1] @ turn[:3, :3].T
    T = np.linalg.inv(poses[0]) @ poses[1] @ turn.T
    return source.astype(np.float32), clouds[0].astype(np.float32), T


def street_drive(seed: int, num_frames: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Scans along a street, round, and back on its other side; their `T_world_i`.

    Scans are `(n, 3)` float32 of 32 rings, 1.2 m apart; nothing moves while one is
    taken.
    """
    rng = np.random.default_rng(seed)
    street, rays = Street.drawn(rng), _rays(-24, 6, 32, 900)
    half, scans, poses = num_frames // 2, [], []
    for k in range(num_frames):
        there = min(k, 2 * half - k)
        turned = np.clip((k - half + 6) / 12, 0, 1)  # within twelve frames
        angles = (
            np.pi * turned + 0.05 * np.sin(k / 5),
            0.01 * np.sin(k / 3),
            0.01 * np.cos(k / 4),
        )
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("zyx", angles).as_matrix()
        T[:3, 3] = 1.2 * there - 30, 2.4 * turned - 1.2, _EYE
        r = street.ranges(T[:3, 3], rays @ T[:3, :3].T, rng)
        seen = (r > _NEAREST) & (r < _FARTHEST) & (rng.random(len(r)) < 0.97)
        r = r[seen] + rng.normal(0, 0.02, seen.sum())
        scans.append((rays[seen] * r[:, None]).astype(np.float32))
        poses.append(T)
    return scans, np.stack(poses)


def _scanner(rng: np.random.Generator) -> np.ndarray:
    """Unit rays `(n, 3)` of rings that spin."""
    top = np.radians(rng.uniform(2, 15))
    return _rays(-24, np.degrees(top), rng.choice([16, 32, 64]), rng.choice([500, 900]))


def _rays(bottom: float, top: float, rings: int, a_turn: int) -> np.ndarray:
    """Unit rays `(n, 3)`; the lowest and the highest ring in degrees."""
    up = np.linspace(np.radians(bottom), np.radians(top), rings)
    around = np.linspace(0, 2 * np.pi, a_turn, endpoint=False)
    up, around = (x.ravel() for x in np.meshgrid(up, around))
    flat = np.cos(up)
    return np.stack([flat * np.cos(around), flat * np.sin(around), np.sin(up)], 1)


def _houses(rng: np.random.Generator, side: int, half: float):
    """Corners of a row, from one end of the street to the other."""
    x = -_HALF
    while x < _HALF:
        wide, deep, tall = rng.uniform((6, 6, 4), (25, 12, 14))
        front = half + rng.uniform(0, 4)
        y = sorted((side * front, side * (front + deep)))
        yield [x, y[0], 0], [x + wide, y[1], tall]
        x += wide + rng.uniform(0, 8) * (rng.random() < 0.7)


def _round(offset: np.ndarray, rays: np.ndarray, radius: float) -> np.ndarray:
    """`(n,)` to a circle or ball whose middle is at minus the offset; or infinity."""
    a, b = np.sum(rays**2, axis=1), rays @ offset
    inside = b * b - a * (offset @ offset - radius * radius)
    t = (-b - np.sqrt(np.maximum(inside, 0))) / np.maximum(a, 1e-12)
    return np.where((inside > 0) & (t > 0), t, np.inf)
