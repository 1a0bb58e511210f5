"""The `.bin` files of KITTI, by blocks; they have float32 alone."""

from io import BufferedIOBase
from pathlib import Path

import numpy as np

from jaxreg.io.moved.motion import Moving
from jaxreg.io.moved.records import blocks
from jaxreg.io.points.kitti import ROW


def move_bin(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes the rows again, with their intensity."""
    with path.open("rb") as file:
        for rows in blocks(file, path.stat().st_size // ROW.itemsize, ROW):
            moved = np.concatenate([moving.points(rows[:, :3]), rows[:, 3:]], axis=1)
            out.write(moved.astype("<f4").tobytes())
