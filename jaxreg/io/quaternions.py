"""Unit quaternions in files, as NumPy arrays in the order xyzw."""

import numpy as np


def motions_from_xyzw(translation: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """`(e, 4, 4)` motions of translations and quaternions; these are normalised."""
    x, y, z, w = np.moveaxis(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, :3] = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1
    )
    T[:, 1, :3] = np.stack(
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1
    )
    T[:, 2, :3] = np.stack(
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
    )
    T[:, :3, 3] = translation
    return T


def xyzw_from_rotations(R: np.ndarray) -> np.ndarray:
    """`(e, 4)` unit quaternions of `(e, 3, 3)` rotations, with w at least 0.

    The columns of 4 q q' are all multiples of q; the longest one is the most accurate.
    """
    R = np.asarray(R, dtype=np.float64)
    diagonal = R[:, range(3), range(3)]
    outer = np.empty((len(R), 4, 4))
    trace = diagonal.sum(axis=1, keepdims=True)
    outer[:, range(3), range(3)] = 1 + 2 * diagonal - trace
    outer[:, 3, 3] = 1 + trace[:, 0]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        outer[:, a, b] = outer[:, b, a] = R[:, a, b] + R[:, b, a]
        c = 3 - a - b
        sign = 1 if (a, b) != (0, 2) else -1
        outer[:, c, 3] = outer[:, 3, c] = sign * (R[:, b, a] - R[:, a, b])
    best = np.argmax(outer[:, range(4), range(4)], axis=1)
    q = outer[np.arange(len(R)), best]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, 3:] < 0, -q, q)
