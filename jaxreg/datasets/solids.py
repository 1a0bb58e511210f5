"""Surfaces for the PF paper's experiments in space: a cube, a truck, a horse.

The cube is that of section 5.1.2. The truck (5.2.1) and the horse (5.2.2) are made of
boxes, wheels and tapered limbs by formulas of our own, of the paper's extent where it
gives one. Points are drawn evenly over the surface, in random order, so the leading
rows of a cloud are a random sample of it. Everything is NumPy on the host; the same
seed gives the same points.
"""

from collections.abc import Callable

import numpy as np


# Of the truck, in metres: x forward, y to the left, z up from the ground.
_BOXES = np.array(
    [
        # low x, y, z, high x, y, z
        [-4.10, -0.45, 0.55, 3.30, 0.45, 0.90],  # frame
        [-4.20, -1.20, 0.90, 1.05, 1.20, 3.25],  # cargo box
        [1.30, -1.10, 0.60, 2.75, 1.10, 2.55],  # cab
        [2.75, -0.85, 0.60, 3.85, 0.85, 1.55],  # bonnet
        [3.70, -1.15, 0.40, 4.00, 1.15, 0.75],  # bumper
        [1.55, -1.45, 1.65, 1.75, -1.10, 2.10],  # mirror on the right
        [1.55, 1.10, 1.65, 1.75, 1.45, 2.10],  # mirror on the left
        [-0.60, 0.45, 0.45, 0.90, 1.05, 0.90],  # tank on the left
    ]
)
_WHEELS = np.array(
    [
        # x, y of the middle, radius, half width; they stand on the ground
        [3.05, 0.98, 0.50, 0.17],
        [3.05, -0.98, 0.50, 0.17],
        [-1.75, 0.98, 0.50, 0.22],
        [-1.75, -0.98, 0.50, 0.22],
        [-3.05, 0.98, 0.50, 0.22],
        [-3.05, -0.98, 0.50, 0.22],
    ]
)
_EXHAUST = np.array([1.17, -0.95, 0.60, 3.60, 0.09])  # x, y, low z, high z, radius
_FRONT = 1.28  # x behind the cab

# Of the horse: y forward, z up. From a to b, the radius going from first to second.
_LIMBS = np.array(
    [
        # a_x, a_y, a_z, b_x, b_y, b_z, radius at a, radius at b
        [0, -36, 10, 0, 26, 8, 22, 21],  # barrel
        [0, 26, 9, 0, 38, 16, 20, 16],  # chest
        [0, -36, 11, 0, -45, 13, 21, 17],  # croup
        [0, 37, 20, 4, 55, 60, 15, 9],  # neck
        [0, 30, 34, 2, 46, 70, 4, 3],  # mane
        [4, 55, 63, 8, 69, 42, 9.5, 5],  # head, turned a little
        [-1, 52, 70, -3, 50, 79.5, 3.5, 2.5],  # ear
        [7, 54, 70, 10, 53, 78, 3.5, 2],  # ear
        [0, -55, 20, -6, -61, 6, 5, 5],  # dock
        [-6, -61, 6, -13, -60, -38, 5, 3],  # tail
        [13, 33, 0, 17, 35, -36, 10, 5.5],  # left foreleg, standing
        [17, 35, -36, 28, 36, -70, 5, 5],
        [-13, 33, 0, -19, 51, -26, 10, 5.5],  # right foreleg, lifted
        [-19, 51, -26, -22, 44, -57, 5, 4],
        [13, -42, 2, 17, -37, -34, 14, 6],  # left hind leg
        [17, -37, -34, 19, -52, -70, 5.5, 5],
        [-13, -42, 2, -22, -47, -34, 14, 6],  # right hind leg, stepping aside
        [-22, -47, -34, -31, -58, -70, 5.5, 5],
    ],
    dtype=float,
)
_BLEND = 5.0


def cube_points(num: int = 400, seed: int = 0, *, side: float = 20.0) -> np.ndarray:
    """Points drawn evenly over the faces of a cube around the origin.

    Args:
        num: how many; the paper's data are 50 of 400.
        seed: of the random numbers.
        side: length of an edge, which is the unit of the result.

    Returns:
        `(num, 3)` float64, rows in random order.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-side / 2, side / 2, (num, 3))
    face = rng.integers(0, 6, num)
    points[np.arange(num), face // 2] = np.where(face % 2, side / 2, -side / 2)
    return points


def truck_points(num: int, seed: int = 0) -> np.ndarray:
    """Points drawn evenly over a truck: cargo box, cab, bonnet, wheels.

    It is 8.2 m long, 2.9 m wide across the mirrors and 3.6 m high, and drives along x,
    y to its left and z up from the ground. A tank on the left and an exhaust on the
    right are all that its left side does not share with its right side.

    Args:
        num: how many.
        seed: of the random numbers.

    Returns:
        `(num, 3)` float64 in metres, rows in random order. `truck_front` tells which
        belong to the front.
    """
    low, high = np.array([-4.3, -1.5, -0.1]), np.array([4.1, 1.5, 3.7])
    return _surface_points(_truck_distance, low, high, 0.02, num, seed)


def truck_front(points: np.ndarray) -> np.ndarray:
    """Which points of the truck lie on its front: cab, bonnet, bumper, front wheels.

    Args:
        points: `(n, 3)` of `truck_points`, in its frame.

    Returns:
        `(n,)` boolean; about a third of the points.
    """
    return points[:, 0] > _FRONT


def horse_like_points(num: int, seed: int = 0) -> np.ndarray:
    """Points drawn evenly over an animal of the extent of the PF paper's horse.

    A closed surface of smoothly joined limbs that stands in
    [-36, 33] x [-67, 74] x [-75, 82], y forward and z up, as the paper's model does
    in its own unit (section 5.2.2). One foreleg is lifted, a hind leg stands aside and
    the tail swings, so that no rotation maps it on itself.

    Args:
        num: how many.
        seed: of the random numbers.

    Returns:
        `(num, 3)` float64 in that unit, rows in random order.
    """
    low, high = np.array([-38.0, -69.0, -77.0]), np.array([35.0, 76.0, 84.0])
    return _surface_points(_horse_distance, low, high, 0.8, num, seed)


def _surface_points(
    distance: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    shell: float,
    num: int,
    seed: int,
) -> np.ndarray:
    """Points drawn evenly from a thin shell about the surface, then put upon it."""
    if num < 1:
        raise ValueError(f"num: wanted at least 1, found {num}.")
    rng = np.random.default_rng(seed)
    found, count = [], 0
    while count < num:
        # About one in twenty lies in the shell.
        trial = rng.uniform(low, high, (max(20 * num, 2000), 3))
        trial = trial[np.abs(distance(trial)) < shell]
        for _ in range(3):
            trial = trial - distance(trial)[:, None] * _slope(distance, trial, shell)
        # What jumped between two parts in a corner is not there yet.
        trial = trial[np.abs(distance(trial)) < 0.01 * shell]
        found.append(trial)
        count += len(trial)
    return np.concatenate(found)[:num]


def _slope(
    distance: Callable[[np.ndarray], np.ndarray], points: np.ndarray, shell: float
) -> np.ndarray:
    """Gradient over its squared norm: the way to the surface per unit of distance."""
    h = 1e-4 * shell
    gradient = np.stack(
        [distance(points + h * e) - distance(points - h * e) for e in np.eye(3)], axis=1
    ) / (2 * h)
    return gradient / np.maximum(np.sum(gradient**2, axis=1, keepdims=True), 0.1)


def _truck_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance to the truck, negative inside."""
    parts = [
        _box(x - (row[:3] + row[3:]) / 2, (row[3:] - row[:3]) / 2) for row in _BOXES
    ]
    for wheel_x, wheel_y, radius, half_width in _WHEELS:
        across = np.hypot(x[:, 0] - wheel_x, x[:, 2] - radius) - radius
        parts.append(_both(across, np.abs(x[:, 1] - wheel_y) - half_width))
    at_x, at_y, low, high, radius = _EXHAUST
    across = np.hypot(x[:, 0] - at_x, x[:, 1] - at_y) - radius
    parts.append(_both(across, np.abs(x[:, 2] - (low + high) / 2) - (high - low) / 2))
    return np.min(parts, axis=0)


def _box(x: np.ndarray, half: np.ndarray) -> np.ndarray:
    beyond = np.abs(x) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return outside + np.minimum(np.max(beyond, axis=1), 0)


def _both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Signed distance to what lies inside two bounds at right angles."""
    return np.hypot(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(
        np.maximum(a, b), 0
    )


def _horse_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance to the horse, negative inside; a little short at the joints."""
    total = np.full(len(x), np.inf)
    for row in _LIMBS:
        a, ab = row[:3], row[3:6] - row[:3]
        along = np.clip((x - a) @ ab / (ab @ ab), 0, 1)
        gap = np.linalg.norm(x - a - along[:, None] * ab, axis=1)
        part = gap - (row[6] + along * (row[7] - row[6]))
        step = np.maximum(_BLEND - np.abs(part - total), 0)
        total = np.minimum(part, total) - step * step / (4 * _BLEND)
    return total
