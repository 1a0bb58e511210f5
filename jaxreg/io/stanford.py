"""Pose files of the Stanford 3D Scanning Repository (`.conf`)."""

from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.points import stem


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
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        reason = getattr(err, "strerror", None) or "not a text file"
        raise InputError(
            f"{path}: cannot be read ({reason}).\nCheck the name of the pose file."
        ) from err
    poses: dict[str, np.ndarray] = {}
    for number, line in enumerate(lines, start=1):
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
        t_x, t_y, t_z, *xyzw = (float(w) for w in words)
        x, y, z, w = np.array(xyzw) / max(np.linalg.norm(xyzw), 1e-12)
    except ValueError as err:
        raise InputError(
            f"{where}: wanted seven numbers after the file name.\nCorrect the line."
        ) from err
    T = np.eye(4)
    T[:3, 3] = t_x, t_y, t_z
    # The transpose of the Hamilton matrix is the rotation of the conjugate.
    T[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).T
    return T
