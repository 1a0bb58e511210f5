"""Small problems of which everything is known."""

import numpy as np


#: Points of a cloud.
NUM_POINTS = 48


def surface(num: int, d: int, seed: int = 0) -> np.ndarray:
    """`(num, d)` samples of an asymmetric closed curve or surface of size one."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((num, d))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    waves = np.array([[2.0, 1.0, 0.5], [-1.0, 2.5, 1.5], [0.5, -1.5, 3.0]])[:, :d]
    height = np.sin(x @ waves.T + [0.3, 1.1, 2.0]) @ [1.0, 0.8, 0.6]
    return (1 + 0.25 * height)[:, None] * x


def motion(d: int, angle: float, shift: float, seed: int = 0) -> np.ndarray:
    """`(d+1, d+1)` a turn by `angle` radians and a translation of about `shift`."""
    rng = np.random.default_rng(seed)
    turn = skew(rng, 1, d)[0]
    turn /= np.linalg.norm(turn) / np.sqrt(2)
    T = np.eye(d + 1)
    T[:d, :d] += np.sin(angle) * turn + (1 - np.cos(angle)) * turn @ turn
    T[:d, d] = shift * rng.standard_normal(d)
    return T


def move(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The image of points."""
    d = points.shape[-1]
    return points @ T[:d, :d].T + T[:d, d]


def pair(d: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy samples of a closed surface, some degrees apart."""
    rng = np.random.default_rng(seed)
    source = surface(NUM_POINTS, d, seed)
    noise = 0.05 * rng.standard_normal(source.shape)
    return source, move(motion(d, 0.15, 0.05, seed), source + noise)


def skew(rng: np.random.Generator, num: int, d: int) -> np.ndarray:
    """Random infinitesimal rotations `(num, d, d)`."""
    turn = rng.standard_normal((num, d, d))
    return turn - turn.swapaxes(1, 2)


NUM_POSES = 5
#: All pairs, and one more, which most problems mask.
EDGES = np.concatenate([np.stack(np.triu_indices(NUM_POSES, 1), axis=1), [[0, 1]]])


def poses(d: int, seed: int = 0) -> np.ndarray:
    """`(v, d+1, d+1)`, the first the identity."""
    angles = [0.0, 1.0, 2.0, 3.0, 2.0]
    T = np.stack([motion(d, a, 0.5, 10 * seed + i) for i, a in enumerate(angles)])
    return np.linalg.inv(T[0]) @ T


def relative_motions(d: int, noise: float, seed: int = 0) -> np.ndarray:
    """`(e, d+1, d+1)` of the edges, turned by `noise` radians, moved by half of it."""
    T_world_i = poses(d, seed)
    errors = [motion(d, noise, noise / 2, 100 * seed + e) for e in range(len(EDGES))]
    i, j = EDGES.T
    return np.linalg.inv(T_world_i[i]) @ T_world_i[j] @ np.stack(errors)
