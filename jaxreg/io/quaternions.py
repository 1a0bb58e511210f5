"""Unit quaternions in files, as NumPy arrays in the order xyzw.

SciPy is imported where it is used: its rotations take a fifth of a second.
"""

import numpy as np


def motions_from_xyzw(translation: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """`(e, 4, 4)` motions of translations and quaternions; these are normalised."""
    from scipy.spatial.transform import Rotation

    T = np.tile(np.eye(4), (len(xyzw), 1, 1))
    if len(xyzw):  # SciPy before 1.17 has no rotations of length zero
        T[:, :3, :3] = Rotation.from_quat(xyzw).as_matrix()
    T[:, :3, 3] = translation
    return T


def xyzw_from_rotations(R: np.ndarray) -> np.ndarray:
    """`(e, 4)` unit quaternions of `(e, 3, 3)` rotations, with w at least 0.

    NaN where a rotation is not finite: of a failed solution there is a file, too.
    """
    from scipy.spatial.transform import Rotation

    known = np.isfinite(R).all(axis=(1, 2))
    xyzw = np.full((len(R), 4), np.nan)
    xyzw[known] = Rotation.from_matrix(R[known]).as_quat(canonical=True)
    return xyzw
