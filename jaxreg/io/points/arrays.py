"""Point sets as NumPy files: one array, or an archive of several."""

import io
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import reading
from jaxreg.io.points.thinning import Step, every_row, records


_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_LONGEST_HEADER = 10_000
_SAVE_NPZ = "Save it with numpy.savez(file, name=points, ...)."
# Of DEFLATE; a header that promises more lies.
_MOST_RATIO = 1100


class _Layout(NamedTuple):
    """Of an array in the NPY format: what its header says, and where the data begin."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype
    start: int


def parse_npy(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The points of an NPY file, `(n, d)`, no names, and of how many one was kept.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of rows which of them to keep.

    Raises:
        InputError: if it holds no `(n, 2)` or `(n, 3)` array of numbers.
    """
    advice = "Save it with numpy.save as one float array of shape (n, 3) or (n, 2)."
    with reading(path, "NumPy", advice):
        size = path.stat().st_size if data is None else len(data)
        with path.open("rb") if data is None else io.BytesIO(data) as file:
            points, every = _some_rows(file, size, str(path), step)
    return points, (), every


def parse_npz(
    path: Path, step: Step = every_row, only: str | None = None
) -> dict[str, tuple[np.ndarray, tuple[str, ...], int]]:
    """The scans of an NPZ file by key, each as `parse_npy` has it.

    They are read by blocks, of which only the rows that are kept stay in memory.

    Args:
        path: the file.
        step: tells from the number of rows which of them to keep.
        only: the key of the one to read; else all whose shape is that of a scan.

    Raises:
        InputError: if an array that is read is none of points, or there is none.
    """
    arrays: dict[str, tuple[np.ndarray, tuple[str, ...], int]] = {}
    with reading(path, "NPZ", _SAVE_NPZ), zipfile.ZipFile(path) as archive:
        infos = _infos(archive)
        if only is not None and only not in infos:
            raise InputError(
                f"{path}: has no scan {only}.\nIt holds: {some_of(list(infos))}."
            )
        keys = _scan_keys(archive, infos) if only is None else [only]
        for key in keys or list(infos)[:1]:  # of no scan, the first says why
            with archive.open(infos[key]) as file:
                size, name = infos[key].file_size, f"{path}:{key}"
                points, every = _some_rows(file, size, name, step)
            arrays[key] = points, (), every
    if not arrays:
        raise InputError(f"{path}: holds no arrays.\nSave each scan under a name.")
    return arrays


def npz_keys(path: Path) -> tuple[list[str], list[str]]:
    """Of the arrays whose shape is that of a scan, and of all others.

    Raises:
        InputError: if it is no NPZ file.
    """
    with reading(path, "NPZ", _SAVE_NPZ), zipfile.ZipFile(path) as archive:
        infos = _infos(archive)
        scans = _scan_keys(archive, infos)
    return scans, [key for key in infos if key not in scans]


def some_of(names: list[str]) -> str:
    """A dozen of them, for messages."""
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def _infos(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The members by key."""
    infos: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        key = info.filename.removesuffix(".npy")
        if key in infos:
            raise ValueError(f"two arrays are called {key}")
        if info.file_size > _MOST_RATIO * (info.compress_size + 100):
            raise ValueError(f"{key} says that it has {info.file_size} bytes")
        infos[key] = info
    return infos


def _scan_keys(
    archive: zipfile.ZipFile, infos: dict[str, zipfile.ZipInfo]
) -> list[str]:
    """Poses, units and notes are often kept beside the scans: their shape tells."""
    keys = []
    for key, info in infos.items():
        with archive.open(info) as file:
            shape = _layout(file).shape
        if len(shape) == 2 and shape[1] in (2, 3):
            keys.append(key)
    return keys


def _some_rows(file: Any, size: int, name: str, step: Step) -> tuple[np.ndarray, int]:
    """Of an array in the NPY format, and of how many one was kept."""
    shape, by_columns, dtype, start = _layout(file)
    _require_points(shape, dtype, name)
    num, width = shape
    if start + num * width * dtype.itemsize != size:
        raise ValueError(
            f"its header promises shape {shape} of {dtype}, {size - start} bytes follow"
        )
    every = step(num)
    if not by_columns:
        return as_points(records(file, num, np.dtype((dtype, (width,))), every)), every
    columns = [records(file, num, dtype, every) for _ in range(width)]
    return as_points(np.stack(columns, axis=1)), every


def _layout(file: Any) -> _Layout:
    """Reads the header; the file stands at the data."""
    head = io.BytesIO(file.read(_LONGEST_HEADER))
    version = np.lib.format.read_magic(head)
    if version not in _HEADERS:
        raise ValueError(f"version {version}")
    shape, by_columns, dtype = _HEADERS[version](head)
    if dtype.hasobject:
        raise ValueError("objects, not plain numbers")
    file.seek(head.tell())
    return _Layout(shape, by_columns, dtype, head.tell())


def _require_points(shape: tuple[int, ...], dtype: np.dtype, name: str) -> None:
    """Refuses arrays of another shape or type before they are read.

    Raises:
        InputError: unless it is `(n, 2)` or `(n, 3)`, n > 0, of numbers.
    """
    if len(shape) != 2 or shape[1] not in (2, 3) or dtype.kind not in "fiu":
        raise InputError(
            f"{name}: found an array of shape {shape} and type {dtype}.\n"
            "Wanted numbers of shape (n, 3) or (n, 2), one point a row."
        )
    if shape[0] == 0:
        raise InputError(f"{name}: holds no points.\nExport or copy the scan again.")


def as_points(array: np.ndarray, name: str = "points") -> np.ndarray:
    """The array as float32 or float64 points; `name` is for messages only.

    Raises:
        InputError: unless it holds numbers of shape `(n, 2)` or `(n, 3)`, n > 0.
    """
    _require_points(array.shape, array.dtype, name)
    narrow = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if narrow else np.float64, copy=False)
