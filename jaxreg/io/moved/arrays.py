"""NPY and NPZ: arrays of points, by blocks where the file allows it."""

import zipfile
from collections.abc import Iterator, Mapping
from io import BufferedIOBase
from pathlib import Path
from typing import cast

import numpy as np

from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.arrays import parse_npz


_ROWS = 1_000_000


def move_npy(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes the array again, float32 where that holds its digits."""
    found = np.load(path, mmap_mode="r", allow_pickle=False)
    parts = (found[k : k + _ROWS] for k in range(0, len(found), _ROWS))
    wide = found.dtype not in (np.float16, np.float32) or moving.goes_far(parts)
    _write(out, found, moving, np.float64 if wide else np.float32)


def move_npz(path: Path, out: BufferedIOBase, motions: Mapping[str, Moving]) -> None:
    """Writes the arrays that have a motion again, one after another."""
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, (found, _, _) in parse_npz(path).items():
            if key not in motions:
                continue
            wide = found.dtype == np.float64 or motions[key].goes_far([found])
            with archive.open(f"{key}.npy", "w", force_zip64=True) as file:
                kind = np.float64 if wide else np.float32
                _write(cast(BufferedIOBase, file), found, motions[key], kind)


def _write(
    out: BufferedIOBase, found: np.ndarray, moving: Moving, kind: type[np.floating]
) -> None:
    head = {"descr": np.dtype(kind).str, "fortran_order": False, "shape": found.shape}
    np.lib.format.write_array_header_1_0(out, head)
    for part in _moved(found, moving):
        out.write(part.astype(kind).tobytes())


def _moved(found: np.ndarray, moving: Moving) -> Iterator[np.ndarray]:
    for k in range(0, len(found), _ROWS):
        yield moving.points(found[k : k + _ROWS])
