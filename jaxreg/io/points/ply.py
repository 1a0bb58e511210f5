"""PLY files, binary and ASCII, through plyfile."""

import io
import os
from pathlib import Path
from types import ModuleType

import numpy as np

from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError, MissingExtraError
from jaxreg.io.points.thinning import Step, every_row


def parse_ply(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The vertices of a PLY file.

    Args:
        data: its content; None maps the file into memory, so that of a large binary
            one only the rows that are kept are read into it.
        path: of the file, and for messages.
        step: tells from the number of rows which of them to keep.

    Returns:
        `(n, d)` float32 unless the file stores float64 coordinates, 2D if the vertices
        have no property z; the names of the properties of a vertex; of how many
        vertices one was kept.

    Raises:
        InputError: if the data are no PLY file or hold no vertices.
        MissingExtraError: if plyfile is not installed.
    """
    plyfile = _plyfile()
    try:
        file = os.fsdecode(path) if data is None else io.BytesIO(data)
        vertex = plyfile.PlyData.read(file)["vertex"].data
        fields = tuple(vertex.dtype.names or ())
        names = ("x", "y", "z") if "z" in fields else ("x", "y")
        every = step(max(len(vertex), 1))
        columns = [np.asarray(vertex[name][::every]) for name in names]
    except (plyfile.PlyParseError, ValueError, KeyError, EOFError, TypeError) as err:
        raise InputError(
            f"{path}: not a complete PLY file with vertices x, y, z ({_short(err)}).\n"
            "Export the scan again, as PLY or as text."
        ) from err
    if len(columns[0]) == 0:
        raise InputError(f"{path}: holds no points.\nExport or copy the scan again.")
    wide = any(c.dtype.kind != "f" or c.dtype.itemsize > 4 for c in columns)
    points = np.stack(columns, axis=1).astype(np.float64 if wide else np.float32)
    return points, fields, every


def write_ply(
    path: str | Path,
    points: np.ndarray,
    colors: np.ndarray | None = None,
    binary: bool = True,
) -> None:
    """Writes points, with colours if given.

    Args:
        path: the file; it appears whole or not at all.
        points: `(n, d)` with d = 2 or 3, float32 or float64 (stored as such). For 2D
            points z = 0 is written, since most viewers insist on it.
        colors: `(n, 3)` uint8, or floats in [0, 1], or None.
        binary: little-endian binary, or ASCII with all digits.

    Raises:
        InputError: if the file cannot be written.
        ValueError: if the shapes do not fit.
        MissingExtraError: if plyfile is not installed.
    """
    plyfile = _plyfile()
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(
            f"points: wanted shape (n, 2) or (n, 3), found {points.shape}."
        )
    kind = "f8" if points.dtype == np.float64 else "f4"
    fields = [(axis, kind) for axis in "xyz"]
    if colors is not None:
        colors = _as_bytes(colors, len(points))
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    vertex = np.zeros(len(points), dtype=fields)
    for k in range(points.shape[1]):
        vertex["xyz"[k]] = points[:, k]
    if colors is not None:
        for k, name in enumerate(("red", "green", "blue")):
            vertex[name] = colors[:, k]
    element = plyfile.PlyElement.describe(vertex, "vertex")
    document = plyfile.PlyData([element], text=not binary, byte_order="<")
    with atomic_write(path, "wb") as file:
        document.write(file)


def _as_bytes(colors: np.ndarray, num: int) -> np.ndarray:
    colors = np.asarray(colors)
    if colors.shape != (num, 3):
        raise ValueError(f"colors: wanted shape ({num}, 3), found {colors.shape}.")
    if colors.dtype.kind == "f":
        colors = np.rint(np.clip(colors, 0, 1) * 255)
    return colors.astype(np.uint8)


def _short(err: Exception) -> str:
    return " ".join(str(err).split())[:80] or type(err).__name__


def _plyfile() -> ModuleType:
    try:
        import plyfile
    except ModuleNotFoundError as err:
        raise MissingExtraError("plyfile", "Reading and writing PLY") from err
    return plyfile
