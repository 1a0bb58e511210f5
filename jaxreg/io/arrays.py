"""Point sets as NumPy files: one array, or an archive of several."""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.thinning import Step, every_row


def parse_npy(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, int]:
    """The points of an NPY file, `(n, d)`, and the number of rows of the file.

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
    num = array.shape[0] if array.ndim else 0
    return as_points(array[:: step(max(num, 1))] if num else array, str(path)), num


def parse_npz(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file by key, each as `parse_npy` has it.

    Raises:
        InputError: if an array is none of points, or there is none.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            arrays = {
                name.removesuffix(".npy"): np.load(
                    io.BytesIO(archive.read(name)), allow_pickle=False
                )
                for name in archive.namelist()
            }
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, zlib.error) as err:
        raise InputError(
            f"{path}: not an NPZ file of plain numbers.\n"
            "Save it with numpy.savez(file, name=points, ...)."
        ) from err
    if not arrays:
        raise InputError(f"{path}: holds no arrays.\nSave each scan under a name.")
    return {key: as_points(a, f"{path}:{key}") for key, a in arrays.items()}


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
