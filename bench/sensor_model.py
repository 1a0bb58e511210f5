"""Scans of the sculpture as a sensor takes them, and the best that they allow.

A regular grid of beams from one place, so that density falls with the range; each beam
has a width, and where it meets an edge its range is a mean of what it meets (a mixed
pixel, which lies on no surface). Noise of the range grows with its square. Returns are
missing where surfaces graze the beam, in discs of the view, and here and there.

The bound is that of Cramer and Rao for the points that other scans see, too, with the
surface known exactly: what a scan of a surface tells of its pose is
sum n n^T / (s^2 (n . u)^2) in the tangent, with normal n, beam u and deviation s.
"""

from typing import NamedTuple

import numpy as np

from jaxreg.datasets.sculpture import random_motions, sculpture_distance


# Half of the field of view at 0.6 m, which holds the sculpture; half a beam, in pixels.
_HALF, _AWAY, _WIDTH = 0.13, 0.6, 0.5
_GRAZING = 0.2  # cosine
_REACH = 0.13  # of the sculpture from its middle, in metres
# Of the discs without returns: how many, and their radius over the field of view.
_HOLES, _HOLE = 3, 0.06
_LOST = 0.03
# Ranges under one beam further apart than so many widths of it are an edge: a surface
# that is seen at all is not as steep.
_EDGE = 6.0


class SensorScan(NamedTuple):
    """One scan with what is known of it.

    Attributes:
        points: `(n, 3)` float32, in the frame of the scanner.
        T_world_scan: its true pose.
        eye: `(3,)` where the scanner stood, in the world.
        true: `(n, 3)` where the middle of each beam met the surface, in the world.
        normal: `(n, 3)` there.
        beam: `(n, 3)` unit direction.
        deviation: `(n,)` of the range; infinite for mixed pixels.
    """

    points: np.ndarray
    T_world_scan: np.ndarray
    eye: np.ndarray
    true: np.ndarray
    normal: np.ndarray
    beam: np.ndarray
    deviation: np.ndarray

    def drawn(self, rng: np.random.Generator, num: int) -> "SensorScan":
        """Of so many points at most."""
        rows = rng.permutation(len(self.points))[:num]
        each = ("points", "true", "normal", "beam", "deviation")
        return self._replace(**{name: getattr(self, name)[rows] for name in each})


def sensor_scans(
    num_views: int, seed: int, noise: float = 2e-4, pixels: int = 110, num: int = 1400
) -> list[SensorScan]:
    """Views from all around, at distances of 0.45 to 0.8 m.

    Args:
        num_views: how many.
        seed: of all that is random.
        noise: deviation of a range of 0.6 m, in metres.
        pixels: on a side of the square field of view.
        num: points that are drawn of a scan with more, so that few programs compile.
    """
    rng = np.random.default_rng(seed)
    turn = np.arange(num_views) / num_views
    azimuth = 2 * np.pi * (turn + rng.uniform(-0.01, 0.01, num_views))
    elevation = np.deg2rad(10 + 40 * np.sin(4 * np.pi * turn + 1))
    frames = random_motions(rng, num_views, 3, spread=0.1)
    return [
        _scan(rng, a, e, T, noise, pixels).drawn(rng, num)
        for a, e, T in zip(azimuth, elevation, frames, strict=True)
    ]


def pair_bound(source: SensorScan, target: SensorScan) -> np.ndarray:
    """`(6, 6)` of the motion between two scans, in the world's tangent (v, w)."""
    both = (source, target), (target, source)
    parts = [np.linalg.inv(information(a, seen_from(b, a.true))) for a, b in both]
    return parts[0] + parts[1]


def pose_bounds(scans: list[SensorScan]) -> np.ndarray:
    """`(v, 6, 6)` of the poses relative to the first, likewise."""
    own = []
    for k, scan in enumerate(scans):
        others = [seen_from(x, scan.true) for n, x in enumerate(scans) if n != k]
        own.append(np.linalg.inv(information(scan, np.any(others, axis=0))))
    return np.stack(own) + own[0]


def information(scan: SensorScan, counted: np.ndarray) -> np.ndarray:
    """`(6, 6)` of the pose by the points that count, about the world's origin."""
    n, p = scan.normal[counted], scan.true[counted]
    slant = np.sum(n * scan.beam[counted], axis=1)
    J = np.concatenate([n, np.cross(p, n)], axis=1)
    return (J / (scan.deviation[counted] * slant)[:, None] ** 2).T @ J


def seen_from(scan: SensorScan, points: np.ndarray) -> np.ndarray:
    """Which points of the surface the scanner saw."""
    away = points - scan.eye
    far = np.linalg.norm(away, axis=1)
    depth = _traced(scan.eye, away / far[:, None])
    return np.abs(depth - far) < 1e-3  # NaN is not


def _scan(
    rng: np.random.Generator,
    azimuth: float,
    elevation: float,
    T: np.ndarray,
    noise: float,
    pixels: int,
) -> SensorScan:
    away = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    eye = rng.uniform(0.45, 0.8) * away
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right)
    side = np.linspace(-1, 1, pixels) * _HALF / _AWAY
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    half = _WIDTH * (side[1] - side[0])
    # The middle of a beam, and its rim.
    corners = half * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    rays = [_rays(grid + corner, away, right, up) for corner in corners]
    every, beams = np.stack([_traced(eye, x) for x in rays]), rays[0]
    seen = (
        np.isfinite(every[0])
        & ~_in_holes(rng, grid)
        & (rng.uniform(size=len(grid)) > _LOST)
    )
    every, beams = every[:, seen], beams[seen]
    middle = every[0]
    spread = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    mixed = spread > _EDGE * 2 * half * middle
    mean = np.where(mixed, np.nanmean(every, axis=0), middle)
    sigma = noise * (middle / _AWAY) ** 2
    depth = mean + sigma * rng.normal(size=len(middle))
    true = eye + middle[:, None] * beams
    points = (eye + depth[:, None] * beams - T[:3, 3]) @ T[:3, :3]
    normal = _normals(true)
    deviation = np.where(mixed, np.inf, sigma)
    return SensorScan(points.astype(np.float32), T, eye, true, normal, beams, deviation)


def _rays(
    at: np.ndarray, away: np.ndarray, right: np.ndarray, up: np.ndarray
) -> np.ndarray:
    rays = -away + at[:, :1] * right + at[:, 1:] * up
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _in_holes(rng: np.random.Generator, grid: np.ndarray) -> np.ndarray:
    middles = rng.uniform(-0.5, 0.5, (_HOLES, 2)) * _HALF / _AWAY
    off = np.linalg.norm(grid[:, None] - middles, axis=-1)
    return (off < _HOLE * 2 * _HALF / _AWAY).any(axis=1)


def _traced(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Depth along rays by sphere tracing, NaN where none comes back."""
    depth, far = np.full(len(rays), np.nan), np.linalg.norm(eye)
    alive, t = np.arange(len(rays)), np.full(len(rays), far - _REACH)
    for _ in range(60):
        step = sculpture_distance(eye + t[alive, None] * rays[alive])
        t[alive] += 0.95 * step
        met = step < 2e-6
        depth[alive[met]] = t[alive[met]]
        alive = alive[~met & (t[alive] < far + _REACH)]
        if not len(alive):
            break
    seen = np.flatnonzero(np.isfinite(depth))
    normal = _normals(eye + depth[seen, None] * rays[seen])
    cosine = -np.sum(normal * rays[seen], axis=1)
    depth[seen[cosine < _GRAZING]] = np.nan
    return depth


def _normals(points: np.ndarray, step: float = 1e-5) -> np.ndarray:
    slopes = [
        sculpture_distance(points + e) - sculpture_distance(points - e)
        for e in step * np.eye(3)
    ]
    normal = np.stack(slopes, axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)
