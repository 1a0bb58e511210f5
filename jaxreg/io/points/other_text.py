"""Text that is none of points: poses, graphs, meshes, and who reads it."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError


# First word of a line, what such a file is, and who reads it.
_WORDS = (
    (
        re.compile(r"(VERTEX|EDGE|FIX|PARAMS|EQUIV)[A-Z0-9_:]*$"),
        "a pose graph",
        "jaxreg average or jaxreg.io.read_g2o (.g2o), jaxreg.io.read_toro (.graph)",
    ),
    (
        re.compile(r"(v|vn|vt|vp|f|usemtl|mtllib)$"),
        "an OBJ mesh",
        "the suffix .obj says so",
    ),
    (re.compile(r"(solid|facet|vertex)$"), "an STL mesh", "the suffix .stl says so"),
    (re.compile(r"bmesh$"), "poses of scans", "jaxreg.io.read_conf or --truth (.conf)"),
)
#: Suffixes of files of poses and graphs: what they are, and who reads them.
OF_POSES = {
    ".g2o": ("a pose graph", "jaxreg average or jaxreg.io.read_g2o"),
    ".graph": ("a pose graph", "jaxreg.io.read_toro"),
    ".log": ("motions or poses", "jaxreg average or jaxreg.io.read_log"),
    ".info": ("information matrices", "jaxreg.io.read_info"),
    ".conf": ("poses of scans", "jaxreg.io.read_conf or --truth"),
    ".tum": ("a trajectory", "jaxreg.io.read_tum"),
}


def refusal(path: Path, what: str, reader: str) -> InputError:
    """The error that names the right reader."""
    return InputError(f"{path}: {what}, not points.\nIt is read by: {reader}.")


def require_points(lines: Sequence[str], path: Path) -> None:
    """Refuses the first lines of a text file that plainly are no points.

    Raises:
        InputError: that says what they are, and who reads it.
    """
    words = [line.split(None, 1)[0] for line in lines]
    for pattern, what, reader in _WORDS:
        if sum(pattern.match(word) is not None for word in words) > 0.5 * len(words):
            raise refusal(path, what, reader)
    try:
        rows = [[float(x) for x in line.split()] for line in lines]
    except ValueError:
        return
    widths = [len(row) for row in rows]
    for size, what, reader in (
        (4, "motions of fragments", "jaxreg average or jaxreg.io.read_log (.log)"),
        (6, "information matrices", "jaxreg.io.read_info (.info)"),
    ):
        block = [3] + [size] * size
        if len(rows) > size and widths[: size + 1] == block:
            if all(x == int(x) >= 0 for x in rows[0] if np.isfinite(x)):
                raise refusal(path, what, reader)
    if not len(set(widths)) == 1:
        return
    table = np.array(rows)
    if table.shape == (4, 4) and (table[3] == [0, 0, 0, 1]).all():
        raise refusal(path, "one motion, a 4 x 4 matrix", "numpy.loadtxt")
    if widths[0] == 12 and _are_motions(table.reshape(-1, 3, 4)):
        raise refusal(path, "poses, 3 x 4 matrices", "jaxreg.io.read_kitti")
    norms = np.linalg.norm(table[:, 4:], axis=1) if widths[0] == 8 else np.zeros(1)
    if len(table) > 1 and np.abs(norms - 1).max() < 1e-3:
        raise refusal(path, "poses with quaternions", "jaxreg.io.read_tum")


def _are_motions(T: np.ndarray) -> bool:
    if not np.isfinite(T).all():
        return False
    R = T[:, :, :3]
    return bool(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-2)
