"""Point sets as NumPy files: one array, or an archive of several."""

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.points.thinning import Step, every_row, records


_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def parse_npy(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The points of an NPY file, `(n, d)`, no names, and of how many one was kept.

    Args:
        data: its content; None maps the file into memory.
        path: of the file, and for messages.
        step: tells from the number of rows which of them to keep.

    Raises:
        InputError: if it holds no `(n, 2)` or `(n, 3)` array of numbers.
    """
    try:
        if data is None:
            array = np.load(path, allow_pickle=False, mmap_mode="r")
        else:
            array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError) as err:
        raise InputError(
            f"{path}: not a NumPy file of plain numbers.\n"
            "Save it with numpy.save as one float array of shape (n, 3) or (n, 2)."
        ) from err
    every = step(max(len(array), 1)) if array.ndim else 1
    return as_points(array[::every] if array.ndim else array, str(path)), (), every


def parse_npz(
    path: Path, step: Step = every_row
) -> dict[str, tuple[np.ndarray, tuple[str, ...], int]]:
    """The arrays of an NPZ file by key, each as `parse_npy` has it.

    They are read by blocks, of which only the rows that are kept stay in memory.

    Raises:
        InputError: if an array is none of points, or there is none.
    """
    try:
        arrays = {}
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as file:
                    arrays[name.removesuffix(".npy")] = _some_rows(file, step)
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, zlib.error) as err:
        raise InputError(
            f"{path}: not an NPZ file of plain numbers.\n"
            "Save it with numpy.savez(file, name=points, ...)."
        ) from err
    if not arrays:
        raise InputError(f"{path}: holds no arrays.\nSave each scan under a name.")
    return {
        key: (as_points(rows, f"{path}:{key}"), (), every)
        for key, (rows, every) in arrays.items()
    }


def _some_rows(file: Any, step: Step) -> tuple[np.ndarray, int]:
    """Of an array in the NPY format, and of how many one was kept."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"version {version}")
    shape, by_columns, dtype = _HEADERS[version](file)
    if dtype.hasobject:
        raise ValueError("objects")
    if len(shape) != 2:  # for the message alone: a view of one zero
        return np.broadcast_to(np.zeros((), dtype), shape), 1
    num, width = shape
    every = step(max(num, 1))
    if not by_columns:
        return records(file, num, np.dtype((dtype, (width,))), every), every
    columns = [records(file, num, dtype, every) for _ in range(width)]
    return np.stack(columns, axis=1), every


def as_points(array: np.ndarray, name: str) -> np.ndarray:
    """The array as float32 or float64 points; `name` is for messages only.

    Raises:
        InputError: unless it holds numbers of shape `(n, 2)` or `(n, 3)`, n > 0.
    """
    if array.ndim != 2 or array.shape[1] not in (2, 3) or array.dtype.kind not in "fiu":
        raise InputError(
            f"{name}: found an array of shape {array.shape} and type {array.dtype}.\n"
            "Wanted numbers of shape (n, 3) or (n, 2), one point a row."
        )
    if array.shape[0] == 0:
        raise InputError(f"{name}: holds no points.\nExport or copy the scan again.")
    narrow = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if narrow else np.float64)
