"""Scenes in 2D: rooms and woods as a lidar sees them, and outlines of things.

Whatever is drawn follows from the generator of random numbers.
"""

from typing import NamedTuple

import numpy as np


# Doors, and how far a scanner stays from walls and furniture, in metres.
_DOOR, _CLEAR = 1.0, 0.3
# Waves of an outline.
_WAVES = 8


class Lidar(NamedTuple):
    """A scanner that turns in the plane; angles in radians, lengths in metres."""

    num_rays: int = 360
    field: float = 2 * np.pi
    reach: float = 10.0
    noise: float = 0.01

    def scan(
        self, walls: np.ndarray, T_world_scan: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """`(n, 2)` what it sees of walls `(w, 2, 2)`, about itself."""
        own, length = self.lengths(walls, T_world_scan)
        nearest = np.min(length, axis=1)
        seen = nearest < self.reach
        told = nearest[seen] + rng.normal(0, self.noise, seen.sum())
        return told[:, None] * own[seen]

    def lengths(
        self, walls: np.ndarray, T_world_scan: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Its rays `(r, 2)`, and `(r, w)` how far each goes to a wall or inf."""
        half = self.field / 2
        angle = np.linspace(-half, half, self.num_rays, endpoint=False)
        own = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ray = (own @ T_world_scan[:2, :2].T)[:, None]
        start = walls[:, 0] - T_world_scan[:2, 2]
        along = walls[:, 1] - walls[:, 0]
        across = _cross(ray, along)
        across = np.where(np.abs(across) < 1e-12, 1e-12, across)
        length, place = _cross(start, along) / across, _cross(start, ray) / across
        met = (place >= 0) & (place <= 1) & (length > 0)
        return own, np.where(met, length, np.inf)


class Floor(NamedTuple):
    """Rooms with doors and furniture.

    Attributes:
        walls: `(w, 2, 2)` ends of straight pieces, of furniture, too.
        x, y: where the walls between rooms are.
        furniture: `(f, 5)` middle, halves of the edges and angle of boxes.
    """

    walls: np.ndarray
    x: np.ndarray
    y: np.ndarray
    furniture: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Floor":
        """Four by three rooms with two to five things in each."""
        x = np.append(0, np.cumsum(rng.uniform(3.5, 7, 4)))
        y = np.append(0, np.cumsum(rng.uniform(3.5, 6, 3)))
        walls, things = [], []
        for k, at in enumerate(x):
            for low, high in zip(y[:-1], y[1:], strict=True):
                walls += _wall((at, low), (at, high), 0 < k < len(x) - 1, rng)
        for k, at in enumerate(y):
            for low, high in zip(x[:-1], x[1:], strict=True):
                walls += _wall((low, at), (high, at), 0 < k < len(y) - 1, rng)
        for left, right in zip(x[:-1], x[1:], strict=True):
            for low, high in zip(y[:-1], y[1:], strict=True):
                for _ in range(rng.integers(2, 6)):
                    middle = rng.uniform((left + 0.5, low + 0.5), (right, high))
                    middle = np.minimum(middle, (right - 0.5, high - 0.5))
                    half, angle = rng.uniform(0.15, 0.7, 2), rng.uniform(0, np.pi)
                    things.append([*middle, *half, angle])
                    walls += _box(middle, half, angle)
        return cls(np.array(walls), x, y, np.array(things))

    def poses(self, num: int, rng: np.random.Generator) -> np.ndarray:
        """`(n, 3, 3)` of a scanner that goes from room to room, turned anyhow."""
        rooms = [(i, j) for j in range(3) for i in range(4)[:: 1 - j % 2 * 2]]
        x, y = ((z[:-1] + z[1:]) / 2 for z in (self.x, self.y))
        middle = np.array([(x[i], y[j]) for i, j in rooms]).T
        way, each = np.linspace(0, len(rooms) - 1, num), np.arange(len(rooms))
        line = np.stack([np.interp(way, each, c) for c in middle], axis=1)
        return np.stack([self._clear(place, rng) for place in line])

    def _clear(self, place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """A pose near a place that nothing is in the way of."""
        while True:
            x, y = there = place + rng.normal(0, 0.6, 2)
            away = there - self.furniture[:, :2]
            turn = np.exp(-1j * self.furniture[:, 4]) * (away @ (1, 1j))
            own = np.stack([np.abs(turn.real), np.abs(turn.imag)], axis=1)
            inside = np.all(own < self.furniture[:, 2:4] + _CLEAR, axis=1)
            gap = min(np.abs(self.x - x).min(), np.abs(self.y - y).min())
            if not inside.any() and gap > _CLEAR:
                return pose(there, rng.uniform(-np.pi, np.pi))


def wood(rng: np.random.Generator) -> np.ndarray:
    """`(w, 2, 2)` pieces of 40 to 120 trunks and bushes in 40 by 40 metres."""
    pieces = []
    for _ in range(rng.integers(40, 120)):
        middle, radius = rng.uniform(0, 40, 2), rng.uniform(0.1, 1.5)
        angle = np.linspace(0, 2 * np.pi, 12, endpoint=False) + rng.uniform(0, 1)
        rough = 0.25 * (radius > 0.4) * rng.normal(size=12)
        ring = np.stack([np.cos(angle), np.sin(angle)], 1)
        ring = middle + radius * (1 + rough)[:, None] * ring
        pieces.append(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
    return np.concatenate(pieces)


def outline(rng: np.random.Generator, angle: np.ndarray) -> np.ndarray:
    """`(n, 2)` points of a smooth closed curve, by the angle at its middle."""
    k = np.arange(1, _WAVES + 1)
    a, b = rng.normal(0, 0.35, (2, _WAVES)) / k**1.3
    turns = angle[:, None] * k
    r = 1 + np.cos(turns) @ a + np.sin(turns) @ b
    return np.stack([np.cos(angle) * r, 0.7 * np.sin(angle) * r], axis=1)


def sampled(walls: np.ndarray, step: float, rng: np.random.Generator) -> np.ndarray:
    """`(n, 2)` points along all walls, a step apart: a map of them."""
    points = []
    for a, b in walls:
        num = max(1, int(np.linalg.norm(b - a) / step))
        share = (np.arange(num) + rng.random()) / num % 1
        points.append(a + share[:, None] * (b - a))
    return np.concatenate(points)


def pose(place: np.ndarray, angle: float) -> np.ndarray:
    """`(3, 3)` in the plane."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, place[0]], [s, c, place[1]], [0, 0, 1]])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _wall(
    start: tuple, end: tuple, door: bool, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """One piece, or two with a door between them."""
    a, b = np.array(start, float), np.array(end, float)
    if not door:
        return [(a, b)]
    before, width = rng.uniform(0.2, 0.7), _DOOR / np.linalg.norm(b - a)
    return [(a, a + before * (b - a)), (a + (before + width) * (b - a), b)]


def _box(middle: np.ndarray, half: np.ndarray, angle: float) -> list:
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    corner = middle + corner @ pose(middle, angle)[:2, :2].T
    return list(zip(corner, np.roll(corner, -1, axis=0), strict=True))
