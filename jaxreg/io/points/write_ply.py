"""Writing PLY files: plyfile."""

from pathlib import Path
from types import ModuleType

import numpy as np

from jaxreg._core.checks import as_host_array, as_host_numbers, check_flag
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import MissingExtraError


def write_ply(
    path: str | Path,
    points: np.ndarray,
    colors: np.ndarray | None = None,
    binary: bool = True,
    *,
    normals: np.ndarray | None = None,
    intensity: np.ndarray | None = None,
) -> None:
    """Writes points, with what else is given.

    Args:
        path: the file; it appears whole or not at all.
        points: `(n, d)` with d = 2 or 3, float32 or float64 (stored as such). For 2D
            points z = 0 is written, since most viewers insist on it.
        colors: `(n, 3)` uint8, or floats in [0, 1], or None.
        binary: little-endian binary, or ASCII with all digits.
        normals: `(n, 3)`, stored as float32, or None.
        intensity: `(n,)`, stored as float32, or None.

    Raises:
        InputError: if the file cannot be written.
        ValueError: if the shapes do not fit.
        MissingExtraError: if plyfile is not installed.
    """
    plyfile = _plyfile()
    points = as_host_array(points, "points")
    if points.dtype.kind not in "iuf":
        raise TypeError(f"points: wanted real numbers, found dtype {points.dtype}.")
    check_flag(binary, "binary")
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(
            f"points: wanted shape (n, 2) or (n, 3), found {points.shape}."
        )
    kind = "f8" if points.dtype == np.float64 else "f4"
    fields = [(axis, kind) for axis in "xyz"]
    more = attributes(len(points), colors, normals, intensity)
    fields += [(k, "u1" if x.dtype == np.uint8 else "f4") for k, x in more.items()]
    vertex = np.zeros(len(points), dtype=fields)
    for k in range(points.shape[1]):
        vertex["xyz"[k]] = points[:, k]
    for name, column in more.items():
        vertex[name] = column
    element = plyfile.PlyElement.describe(vertex, "vertex")
    document = plyfile.PlyData([element], text=not binary, byte_order="<")
    with atomic_write(path, "wb") as file:
        document.write(file)


def attributes(
    num: int, colors: object, normals: object, intensity: object
) -> dict[str, np.ndarray]:
    """Columns of so many rows by the names that PLY gives them: uint8, or float32.

    Raises:
        ValueError, TypeError: for shapes and dtypes that do not fit.
    """
    found: dict[str, np.ndarray] = {}
    if normals is not None:
        values = as_host_numbers(normals, "normals")
        if values.shape != (num, 3):
            raise ValueError(f"normals: wanted shape ({num}, 3), found {values.shape}.")
        columns = values.astype(np.float32).T
        found |= dict(zip(("nx", "ny", "nz"), columns, strict=True))
    if colors is not None:
        columns = _as_bytes(colors, num).T
        found |= dict(zip(("red", "green", "blue"), columns, strict=True))
    if intensity is not None:
        values = as_host_numbers(intensity, "intensity")
        if values.shape != (num,):
            raise ValueError(f"intensity: wanted shape ({num},), found {values.shape}.")
        found["intensity"] = values.astype(np.float32)
    return found


def _as_bytes(colors: object, num: int) -> np.ndarray:
    found = as_host_array(colors, "colors")
    if found.shape != (num, 3):
        raise ValueError(f"colors: wanted shape ({num}, 3), found {found.shape}.")
    if found.dtype.kind == "f":
        found = np.rint(np.clip(found, 0, 1) * 255)
    elif found.dtype.kind not in "iu":
        raise TypeError(f"colors: wanted uint8 or floats, found dtype {found.dtype}.")
    if not ((found >= 0) & (found <= 255)).all():
        raise ValueError("colors: wanted numbers from 0 to 255, or floats in [0, 1].")
    return found.astype(np.uint8)


def _plyfile() -> ModuleType:
    try:
        import plyfile
    except ModuleNotFoundError as err:
        raise MissingExtraError("plyfile", "Writing PLY") from err
    return plyfile
