"""An asymmetric sculpture given by a formula, and range scans of it.

The surface is the zero level of a smooth union of tapered limbs and rings, no two of
them alike, with a hollow cut out. It is about 0.2 m tall and has no symmetry, so that
the scans determine their poses. Everything is NumPy on the host.
"""

from collections.abc import Callable

import numpy as np


# Limbs: from a to b, in metres, the radius going from the first to the second.
_LIMBS = np.array(
    [
        # a_x, a_y, a_z, b_x, b_y, b_z, radius at a, radius at b
        [0.000, 0.000, -0.062, 0.012, 0.004, 0.022, 0.040, 0.026],  # trunk
        [0.012, 0.004, 0.022, 0.034, -0.014, 0.066, 0.024, 0.017],  # neck, head
        [0.034, -0.014, 0.066, 0.068, -0.026, 0.060, 0.014, 0.006],  # beak
        [0.020, 0.006, 0.070, -0.006, 0.022, 0.102, 0.010, 0.004],  # crest
        [-0.012, 0.020, 0.000, -0.058, 0.044, 0.030, 0.014, 0.009],  # wing
        [-0.058, 0.044, 0.030, -0.052, 0.058, 0.072, 0.009, 0.004],  # wing tip
        [0.012, -0.028, -0.050, 0.052, -0.054, -0.084, 0.015, 0.011],  # long foot
        [-0.018, 0.026, -0.064, -0.022, 0.052, -0.086, 0.016, 0.013],  # short foot
        [0.014, 0.022, -0.030, 0.046, 0.052, -0.044, 0.010, 0.006],  # arm
    ]
)
# Rings: centre, axis (normalised below), radius of the ring and of its tube.
_RINGS = np.array(
    [
        [-0.034, -0.026, -0.018, 0.75, -0.45, 0.48, 0.030, 0.0085],  # handle
        [0.016, 0.024, 0.046, -0.30, 0.60, 0.74, 0.018, 0.0060],  # collar
    ]
)
_HOLLOW = (np.array([0.038, -0.022, -0.010]), 0.021)
_BLEND = 0.012
_RADIUS = 0.13  # of a ball around the origin that holds everything
_DISTANCE = 0.6
_GRAZING = 0.2  # cosine of incidence below which a scanner sees nothing


def sculpture_distance(points: np.ndarray) -> np.ndarray:
    """The signed distance to the sculpture, negative inside.

    At most a few per cent more than the true distance in magnitude; exact in sign.

    Args:
        points: `(n, 3)` in metres, in the frame of the sculpture (z up).

    Returns:
        `(n,)` in metres, of the same dtype.
    """
    parts = [*_limbs(points, _LIMBS.astype(points.dtype))]
    parts += [_ring(points, row) for row in _RINGS.astype(points.dtype)]
    total = parts[0]
    for part in parts[1:]:
        total = _smooth_min(total, part)
    centre, radius = _HOLLOW
    hollow = _norm(points - centre.astype(points.dtype)) - points.dtype.type(radius)
    return -_smooth_min(-total, hollow)


def sculpture_scans(
    num_views: int = 12,
    *,
    seed: int = 0,
    noise: float = 2e-4,
    points_per_scan: int = 8000,
) -> tuple[list[np.ndarray], np.ndarray]:
    """Scans the sculpture from around it: visible side only, noisy, frames scattered.

    Rays are cast from viewpoints 0.6 m away at azimuths all around and elevations from
    -30 to 50 degrees. Every scan is given in a frame of its own, moved by a random
    rigid motion, so that nothing can be read from the frames. The same seed gives the
    same scans.

        >>> from jaxreg.datasets import sculpture_scans
        >>> scans, T_world_i = sculpture_scans(2, points_per_scan=500)
        >>> len(scans), T_world_i.shape
        (2, (2, 4, 4))

    Args:
        num_views: number of scans.
        seed: of the noise, the viewpoints' jitter and the frames.
        noise: standard deviation of the range along each ray, in metres.
        points_per_scan: about how many points each scan gets.

    Returns:
        A list of `(n_i, 3)` float32 scans in metres, and the true `T_world_i`,
        `(num_views, 4, 4)` float64; the world is the frame of scan 0.
    """
    rng = np.random.default_rng(seed)
    turn = np.arange(num_views) / num_views
    azimuth = 2 * np.pi * (turn + rng.uniform(-0.01, 0.01, num_views))
    elevation = np.deg2rad(10 + 40 * np.sin(4 * np.pi * turn + 1))
    scans, T_sculpture_i = [], random_motions(rng, num_views, 3, spread=0.1)
    for k in range(num_views):
        points = _scan(azimuth[k], elevation[k], noise, points_per_scan, rng)
        R, t = T_sculpture_i[k, :3, :3], T_sculpture_i[k, :3, 3]
        scans.append(((points - t) @ R).astype(np.float32))
    return scans, np.linalg.inv(T_sculpture_i[0]) @ T_sculpture_i


def random_motions(
    rng: np.random.Generator, num: int, d: int, spread: float
) -> np.ndarray:
    """Rotations uniform over SO(d) with normal translations, `(num, d+1, d+1)`.

    Args:
        rng: the source of random numbers.
        num: how many.
        d: 2 or 3.
        spread: standard deviation of the translations.
    """
    Q, R = np.linalg.qr(rng.normal(size=(num, d, d)))
    Q = Q * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None, :]
    Q[:, :, 0] *= np.sign(np.linalg.det(Q))[:, None]
    T = np.tile(np.eye(d + 1), (num, 1, 1))
    T[:, :d, :d], T[:, :d, d] = Q, rng.normal(scale=spread, size=(num, d))
    return T


def _scan(
    azimuth: float, elevation: float, noise: float, num: int, rng: np.random.Generator
) -> np.ndarray:
    """Points seen from one viewpoint, in the frame of the sculpture, float64."""
    away = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    eye = _DISTANCE * away
    # A coarse look tells which window holds the sculpture and how much of it is hit.
    window = np.array([[-1.0, -1.0], [1.0, 1.0]]) * _RADIUS / _DISTANCE
    offsets, rays = _rays(away, window, 1600, rng)
    seen = offsets[np.isfinite(_trace(eye, rays))]
    margin = 2 * (window[1] - window[0]) / 40
    window = np.stack([seen.min(axis=0) - margin, seen.max(axis=0) + margin])
    share = len(seen) / 1600 * (2 * _RADIUS / _DISTANCE) ** 2
    _, rays = _rays(
        away, window, int(num * np.prod(window[1] - window[0]) / share), rng
    )
    depth = _trace(eye, rays)
    hit = np.isfinite(depth)
    rays, depth = rays[hit], depth[hit]
    depth = depth + noise * rng.normal(size=depth.shape)
    return eye + depth[:, None] * rays


def _rays(
    away: np.ndarray, window: np.ndarray, num: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A jittered grid of about `num` tangents in a window, and their directions."""
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right)
    span = window[1] - window[0]
    counts = np.maximum(np.rint(np.sqrt(num * span / span[::-1])), 1).astype(int)
    grid = np.stack(np.meshgrid(*map(np.arange, counts)), axis=-1).reshape(-1, 2)
    offsets = window[0] + (grid + rng.uniform(0.2, 0.8, grid.shape)) / counts * span
    rays = -away + offsets[:, :1] * right + offsets[:, 1:] * up
    return offsets, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _trace(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Depth along each ray by sphere tracing, NaN where nothing is seen."""
    depth = np.full(len(rays), np.nan)
    t = np.full(len(rays), _DISTANCE - _RADIUS, dtype=np.float32)
    eye32, rays32 = eye.astype(np.float32), rays.astype(np.float32)
    alive = np.arange(len(rays))
    for _ in range(60):
        step = sculpture_distance(eye32 + t[alive, None] * rays32[alive])
        t[alive] += np.float32(0.95) * step
        hit = step < 2e-5
        depth[alive[hit]] = t[alive[hit]]
        alive = alive[~hit & (t[alive] < _DISTANCE + _RADIUS)]
        if len(alive) == 0:
            break
    seen = np.flatnonzero(np.isfinite(depth))
    normal = _gradient(sculpture_distance, eye + depth[seen, None] * rays[seen])
    cosine = -np.sum(normal * rays[seen], axis=1)
    depth[seen[cosine < _GRAZING * np.linalg.norm(normal, axis=1)]] = np.nan
    return depth


def _gradient(
    fn: Callable[[np.ndarray], np.ndarray], points: np.ndarray, step: float = 2e-4
) -> np.ndarray:
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=float)
    values = [fn(points + step * corner)[:, None] * corner for corner in corners]
    return np.sum(values, axis=0) / (4 * step)


def _limbs(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Distance to every limb, `(limbs, n)`; products of matrices, for speed."""
    a, ab = rows[:, :3], rows[:, 3:6] - rows[:, :3]
    length_sq = np.einsum("ij,ij->i", ab, ab)[:, None]
    from_a_sq = np.einsum("ij,ij->i", x, x) - 2 * (a @ x.T)
    from_a_sq += np.einsum("ij,ij->i", a, a)[:, None]
    dot = ab @ x.T - np.einsum("ij,ij->i", ab, a)[:, None]
    along = np.clip(dot / length_sq, 0, 1)
    gap_sq = np.maximum(from_a_sq + along * (along * length_sq - 2 * dot), 0)
    return np.sqrt(gap_sq) - (rows[:, 6:7] + along * (rows[:, 7:8] - rows[:, 6:7]))


def _ring(x: np.ndarray, row: np.ndarray) -> np.ndarray:
    axis = row[3:6] / np.linalg.norm(row[3:6])
    height = (x - row[:3]) @ axis
    out = np.sqrt(np.maximum(_norm(x - row[:3]) ** 2 - height**2, 0))
    return np.sqrt((out - row[6]) ** 2 + height**2) - row[7]


def _smooth_min(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    h = np.maximum(_BLEND - np.abs(a - b), 0)
    return np.minimum(a, b) - h * h / (4 * _BLEND)


def _norm(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", x, x))
