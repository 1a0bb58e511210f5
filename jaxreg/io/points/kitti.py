"""The `.bin` files of KITTI: rows of x, y, z and intensity, float32, nothing else."""

import io
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.points.thinning import Step, every_row, records


FIELDS = ("x", "y", "z", "intensity")
ROW = np.dtype(("<f4", (len(FIELDS),)))
# No lidar sees as far, in any unit; other bytes read as float32 seldom stay below.
_FARTHEST = 1e9


def parse_bin(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The points, `(n, 3)` float32, names of columns, and of how many one was kept.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of rows which of them to keep.

    Raises:
        InputError: if its bytes are no such rows.
    """
    size = path.stat().st_size if data is None else len(data)
    num, rest = divmod(size, ROW.itemsize)
    if rest:
        raise _other(path, f"{size:,} bytes are no rows of 16")
    every = step(num)
    with path.open("rb") if data is None else io.BytesIO(data) as file:
        points = records(file, num, ROW, every)[:, :3]
    found = np.abs(points[np.isfinite(points)])
    if found.size < 0.5 * points.size or np.any(found > _FARTHEST):
        raise _other(path, "its numbers are no coordinates")
    return np.ascontiguousarray(points), FIELDS, every


def _other(path: Path, why: str) -> InputError:
    return InputError(
        f"{path}: {why}.\nOf .bin files those of KITTI are read, float32 x y z "
        "intensity; save others with numpy.save."
    )
