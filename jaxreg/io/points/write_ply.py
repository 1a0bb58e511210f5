"""Writing PLY files: plyfile."""

from pathlib import Path
from types import ModuleType

import numpy as np

from jaxreg._core.checks import as_host_array, check_flag
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import MissingExtraError


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
    colors = as_host_array(colors, "colors")
    if colors.shape != (num, 3):
        raise ValueError(f"colors: wanted shape ({num}, 3), found {colors.shape}.")
    if colors.dtype.kind == "f":
        colors = np.rint(np.clip(colors, 0, 1) * 255)
    elif colors.dtype.kind not in "iu":
        raise TypeError(f"colors: wanted uint8 or floats, found dtype {colors.dtype}.")
    if not ((colors >= 0) & (colors <= 255)).all():
        raise ValueError("colors: wanted numbers from 0 to 255, or floats in [0, 1].")
    return colors.astype(np.uint8)


def _plyfile() -> ModuleType:
    try:
        import plyfile
    except ModuleNotFoundError as err:
        raise MissingExtraError("plyfile", "Writing PLY") from err
    return plyfile
