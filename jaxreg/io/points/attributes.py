"""Normals and colours of the rows that `read_named` keeps of a file."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.files import is_packed, open_bytes, reading, text_lines
from jaxreg.io.points import e57, las, pcd, ply, text
from jaxreg.io.points.columns import COLORS, NORMALS, named
from jaxreg.io.points.read import TEXT, suffix_of


class Attributes(NamedTuple):
    """`(n, 3)` float32 normals and uint8 colours, None for what a file lacks."""

    normals: np.ndarray | None
    colors: np.ndarray | None


def read_attributes(
    path: Path, fields: Sequence[str], every: int = 1, key: str | None = None
) -> Attributes:
    """Of one of so many rows, as they are in the frame of the file.

    Args:
        path: a file of points.
        fields: names of its columns, as `read_named` tells them.
        every: the `step` that it tells.
        key: the scan, of an archive.

    Raises:
        InputError: if the file cannot be read.
    """
    normals, colors = named(fields, NORMALS), named(fields, COLORS)
    if suffix_of(path) == ".e57":
        normals = None  # of an extension that pye57 does not know
    names = [*(normals or ()), *(colors or ())]
    if not names:
        return Attributes(None, None)
    with reading(path, suffix_of(path)[1:].upper()):
        columns = _columns(path, names, every, key)
    found = columns[len(normals or ()) :]
    return Attributes(
        None if normals is None else np.stack(columns[:3], axis=1).astype(np.float32),
        None if colors is None else _as_bytes(found),
    )


def _columns(
    path: Path, names: list[str], every: int, key: str | None
) -> list[np.ndarray]:
    suffix = suffix_of(path)
    if suffix in TEXT:
        return list(text.parse_columns(text_lines(path), path, names, every).T)
    if suffix == ".e57":
        return e57.read_columns(path, key, names, every)
    data = None
    if is_packed(path):
        with open_bytes(path) as file:
            data = file.read()
    if suffix == ".ply":
        return ply.read_columns(data, path, names, every)
    if suffix == ".pcd":
        return pcd.read_columns(data, path, names, every)
    return las.read_columns(data, path, names, every)


def _as_bytes(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Bytes; numbers of 16 bits, floats in [0, 1] and PCL's packed ones as well."""
    if len(columns) == 1:
        packed = np.ascontiguousarray(columns[0])
        bits = packed.astype(np.float32).view(np.uint32)
        bits = bits if packed.dtype.kind == "f" else packed.astype(np.uint32)
        columns = [(bits >> shift) & 255 for shift in (16, 8, 0)]
    values = np.nan_to_num(np.stack(columns, axis=1).astype(np.float64))
    top = values.max(initial=0)
    whole = columns[0].dtype.kind in "iu"
    if top > 255:
        values = values / 256
    elif top <= 1 and not whole:
        values = np.rint(values * 255)
    return np.clip(values, 0, 255).astype(np.uint8)
