"""Writing points, by the suffix of the file."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxreg._core.checks import as_host_array
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.extras import require
from jaxreg.io.points.read import suffix_of
from jaxreg.io.points.write_ply import attributes, write_ply


_TEXT = {".xyz": " ", ".txt": " ", ".csv": ","}


def write_points(
    path: str | Path,
    points: Any,
    *,
    colors: Any = None,
    normals: Any = None,
    intensity: Any = None,
) -> None:
    """Writes one point set: PLY, PCD, LAS, LAZ, XYZ, TXT, CSV or NPY by the suffix.

        >>> import numpy as np, pathlib, tempfile
        >>> from jaxreg import io
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "corner.csv"
        >>> io.write_points(path, np.eye(3), intensity=[0.1, 0.2, 0.3])
        >>> print(path.read_text().splitlines()[0])
        x,y,z,intensity

    To move a file with all that it holds see `write_moved`.

    Args:
        path: the file; it appears whole or not at all.
        points: `(n, d)` with d = 2 or 3, float32 or float64, in any unit. PLY, PCD and
            LAS have z = 0 for 2D points.
        colors: `(n, 3)` uint8, or floats in [0, 1].
        normals: `(n, 3)`.
        intensity: `(n,)`; in LAS as integers up to 65535, floats in [0, 1] times that.

    Raises:
        InputError: for another suffix, and if the file cannot be written.
        ValueError, TypeError: for shapes and dtypes that do not fit.
        MissingExtraError: if the package that writes this kind is not installed.
    """
    path = Path(path)
    found = as_host_array(points, "points")
    if found.dtype.kind not in "iuf":
        raise TypeError(f"points: wanted real numbers, found dtype {found.dtype}.")
    if found.ndim != 2 or found.shape[1] not in (2, 3):
        raise ValueError(f"points: wanted shape (n, 2) or (n, 3), found {found.shape}.")
    suffix = suffix_of(path)
    if suffix == ".ply":
        write_ply(path, found, colors, normals=normals, intensity=intensity)
        return
    more = attributes(len(found), colors, normals, intensity)
    writers = {".pcd": _write_pcd, ".las": _write_las, ".laz": _write_las}
    writers |= {".npy": _write_npy} | dict.fromkeys(_TEXT, _write_text)
    if suffix not in writers or path.name.lower().endswith(".gz"):
        raise InputError(
            f"{path}: no kind of file that points are written to.\n"
            f"Wanted .ply, {', '.join(writers)}."
        )
    writers[suffix](path, found, more)


def _solid(points: np.ndarray) -> np.ndarray:
    """With z = 0 for 2D points."""
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 1)))


def _write_npy(path: Path, points: np.ndarray, more: dict[str, np.ndarray]) -> None:
    if more:
        raise InputError(
            f"{path}: an NPY file holds coordinates alone.\nWrite .ply, or leave out "
            f"{', '.join(more)}."
        )
    with atomic_write(path, "wb") as file:
        np.save(file, points)


def _write_text(path: Path, points: np.ndarray, more: dict[str, np.ndarray]) -> None:
    separator = _TEXT[suffix_of(path)]
    table = np.column_stack([points, *more.values()])
    digits = "%.9g" if points.dtype == np.float32 else "%.17g"
    forms = [digits] * points.shape[1]
    forms += ["%d" if x.dtype == np.uint8 else "%.9g" for x in more.values()]
    names = [*"xyz"[: points.shape[1]], *more]
    with atomic_write(path) as file:
        head = separator.join(names)
        np.savetxt(file, table, forms, separator, header=head, comments="")


def _write_pcd(path: Path, points: np.ndarray, more: dict[str, np.ndarray]) -> None:
    pypcd4 = require("pypcd4", "Writing PCD")
    wide = points.dtype != np.float32
    kind = np.float64 if wide else np.float32
    columns = dict(zip("xyz", _solid(points).astype(kind).T, strict=True))
    for name, key in (("nx", "normal_x"), ("ny", "normal_y"), ("nz", "normal_z")):
        if name in more:
            columns[key] = more[name]
    if "red" in more:
        rgb = np.stack([more[c] for c in ("red", "green", "blue")], axis=1)
        columns["rgb"] = pypcd4.PointCloud.encode_rgb(rgb)
    if "intensity" in more:
        columns["intensity"] = more["intensity"]
    cloud = pypcd4.PointCloud.from_points(
        list(columns.values()), list(columns), [x.dtype for x in columns.values()]
    )
    with atomic_write(path, "wb") as file:
        cloud.save(file, encoding=pypcd4.Encoding.BINARY)


def _write_las(path: Path, points: np.ndarray, more: dict[str, np.ndarray]) -> None:
    laspy = require("laspy", "Writing LAS and LAZ")
    require("lazrs", "Writing LAZ")
    points = _solid(points).astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: LAS holds finite coordinates alone.\nDrop others.")
    header = laspy.LasHeader(version="1.4", point_format=7 if "red" in more else 6)
    low = points.min(axis=0)
    header.offsets = np.floor(low)
    # Fine enough for a millionth of the extent, coarse enough for an int32.
    extent = max(1.0, float((points - low).max()))  # one, as offsets are whole numbers
    header.scales = np.full(3, 10.0 ** np.ceil(np.log10(extent / 1e9)))
    for name in ("nx", "ny", "nz"):
        if name in more:
            header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32))
    out = laspy.LasData(header)
    out.x, out.y, out.z = points.T
    for name, column in more.items():
        if column.dtype == np.uint8:
            out[name] = column.astype(np.uint16) * 257
        elif name == "intensity":
            top = 65535 if column.max(initial=0) <= 1 else 1
            out[name] = np.clip(np.rint(column * top), 0, 65535).astype(np.uint16)
        else:
            out[name] = column
    with atomic_write(path, "wb") as file:
        out.write(file, do_compress=suffix_of(path) == ".laz")
