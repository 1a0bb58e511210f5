"""Binary records of a file, read by blocks, moved, and written to another."""

from collections.abc import Iterator, Sequence
from io import BufferedIOBase
from typing import Any

import numpy as np

from jaxreg.io.moved.motion import Moving


_BYTES = 1 << 25  # that are in memory at a time


def blocks(file: BufferedIOBase, num: int, dtype: np.dtype) -> Iterator[np.ndarray]:
    """The next records of a file.

    Raises:
        EOFError: if it ends before.
    """
    size = max(1, _BYTES // max(dtype.itemsize, 1))
    for start in range(0, num, size):
        count = min(size, num - start)
        data = file.read(count * dtype.itemsize)
        if len(data) < count * dtype.itemsize:
            raise EOFError("cut off")
        yield np.frombuffer(data, dtype)


def columns(rows: Any, names: Sequence[str]) -> np.ndarray:
    """`(n, k)` of fields of records."""
    return np.stack([rows[name] for name in names], axis=1)


def widened(dtype: np.dtype, names: Sequence[str]) -> np.dtype:
    """With these fields as float64 of the same byte order."""
    old = {name: dtype[name] for name in dtype.names or ()}
    order = ">" if any(kind.byteorder == ">" for kind in old.values()) else "<"
    wide = np.dtype(f"{order}f8")
    return np.dtype([(n, wide if n in names else kind) for n, kind in old.items()])


def move_rows(
    rows: np.ndarray,
    dtype: np.dtype,
    moving: Moving,
    names: Sequence[str],
    normals: Sequence[str] | None,
) -> np.ndarray:
    """Records of the new type, their points moved and their normals turned."""
    out = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        out[name] = rows[name]
    moved = moving.points(columns(rows, names))
    for name, column in zip(names, moved.T, strict=True):
        out[name] = column
    if normals is not None and len(normals) == moving.dim:
        turned = moving.directions(columns(rows, normals))
        for name, column in zip(normals, turned.T, strict=True):
            out[name] = column
    return out
