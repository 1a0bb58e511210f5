"""Pose files of the Stanford 3D Scanning Repository (`.conf`)."""

from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import text_lines
from jaxreg.io.points.read import stem
from jaxreg.io.quaternions import motions_from_xyzw


def read_conf(path: str | Path) -> dict[str, np.ndarray]:
    """Reads the poses of the scans of a `.conf` file.

    A line `bmesh FILE tx ty tz qx qy qz qw` moves the scan by the rotation of the
    CONJUGATE of that quaternion (scalar last), then by t. Lines of other kinds
    (`camera`, `mesh`) are no poses of scans and are passed over.

    Args:
        path: the file.

    Returns:
        For each scan, by file name without suffix and in file order, `T_world_scan`,
        `(4, 4)` float64, lengths in the unit of the file.

    Raises:
        InputError: if the file is missing, unreadable, or holds no pose.
    """
    poses: dict[str, np.ndarray] = {}
    for number, line in text_lines(path):
        words = line.split()
        if words and words[0] == "bmesh":
            poses[stem(words[1])] = _pose(words[2:], f"{path}, line {number}")
    if not poses:
        raise InputError(
            f"{path}: holds no line 'bmesh FILE tx ty tz qx qy qz qw'.\n"
            "Wanted a pose file of the Stanford 3D Scanning Repository."
        )
    return poses


def _pose(words: list[str], where: str) -> np.ndarray:
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not numbers[3:].any():
        raise InputError(
            f"{where}: wanted seven numbers after the file name, a position and a "
            "quaternion.\nCorrect the line."
        )
    # The rotation is that of the conjugate.
    t, xyzw = numbers[None, :3], numbers[None, 3:] * [-1, -1, -1, 1]
    return motions_from_xyzw(t, xyzw)[0]
