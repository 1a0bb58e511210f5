"""`write_moved`: one entry point that goes by the suffix, as `read_points` does."""

import gzip
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg._core.checks import as_host_numbers, check_rigid
from jaxreg.io.atomic import atomic_write
from jaxreg.io.files import is_packed, open_bytes, reading
from jaxreg.io.moved.arrays import move_npy, move_npz
from jaxreg.io.moved.e57 import move_e57
from jaxreg.io.moved.kitti import move_bin
from jaxreg.io.moved.las import move_las
from jaxreg.io.moved.meshes import move_obj, move_stl
from jaxreg.io.moved.motion import Moving
from jaxreg.io.moved.pcd import move_pcd
from jaxreg.io.moved.ply import move_ply
from jaxreg.io.moved.text import move_text
from jaxreg.io.points.read import ARCHIVES, TEXT, require_known, suffix_of


_MOVERS = {
    ".ply": move_ply,
    ".pcd": move_pcd,
    ".bin": move_bin,
    ".las": move_las,
    ".laz": move_las,
    ".obj": move_obj,
    ".stl": move_stl,
    ".npy": move_npy,
    **dict.fromkeys(TEXT, move_text),
}


def write_moved(
    path: str | Path, source: str | Path, T: Any | Mapping[str, Any]
) -> None:
    r"""Writes a file of points again with its points moved, all else as it was.

    Colours, intensity, classification, faces, comments and what a format has more are
    kept; normals turn. The file is read and written by blocks, so that it may be
    larger than memory (but for `binary_compressed` PCD and the arrays of an NPZ).

        >>> import numpy as np, pathlib, tempfile
        >>> from jaxreg import io
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> _ = (folder / "a.xyz").write_text("x y z name\n1.000 2.000 3.000 top\n")
        >>> T = np.eye(4)
        >>> T[0, 3] = 10
        >>> io.write_moved(folder / "b.xyz", folder / "a.xyz", T)
        >>> print((folder / "b.xyz").read_text())
        x y z name
        11.000 2.000 3.000 top
        <BLANKLINE>

    Coordinates in float32 that go far away, as into a map's, become float64; those of
    LAS get new offsets, and KITTI's `.bin` has float32 alone. Text has as many decimals
    as before, at least three. Of E57 the poses change, not the points.

    Args:
        path: the new file, with the suffix of the old one; it appears whole or not.
        source: a file as for `read_points`.
        T: `(d+1, d+1)` motion of its points, its rotation may be times a factor; for
            NPZ and E57 one for each scan by name, and the others are left out.

    Raises:
        InputError: if the file cannot be read or written.
        MissingExtraError: if the package that this kind needs is not installed.
        ValueError: for a matrix that is no motion, and for another suffix.
    """
    path, source = Path(path), Path(source)
    suffix = suffix_of(source)
    require_known(source, suffix)
    if suffix_of(path) != suffix:
        raise ValueError(f"path: wanted the suffix {suffix} like source, found {path}.")
    many = suffix in ARCHIVES
    if many != isinstance(T, Mapping):
        wanted = "a motion for each scan by name" if many else "one motion"
        raise ValueError(f"T: wanted {wanted} for {suffix}, found {type(T).__name__}.")
    with (
        reading(source, suffix[1:].upper()),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".jaxreg-moved-") as folder,
    ):
        plain = _unpacked(source, Path(folder) / f"old{suffix}")
        if suffix == ".e57":
            move_e57(plain, Path(folder) / "new.e57", _all(T))
            (Path(folder) / "new.e57").replace(path)
            return
        with atomic_write(path, "wb") as raw:
            packed: Any = raw
            if is_packed(path):
                packed = gzip.GzipFile(fileobj=raw, mode="wb", mtime=0)
            if many:
                move_npz(plain, packed, _all(T))
            else:
                _MOVERS[suffix](plain, packed, _moving(T, "T"))
            if packed is not raw:
                packed.close()


def _unpacked(source: Path, place: Path) -> Path:
    """The file, or its content beside where it was packed and is no text."""
    if not is_packed(source) or suffix_of(source) in TEXT:
        return source
    with open_bytes(source) as file, place.open("wb") as out:
        shutil.copyfileobj(file, out, 1 << 24)
    return place


def _all(T: Mapping[str, Any]) -> dict[str, Moving]:
    return {name: _moving(one, f"T[{name!r}]") for name, one in T.items()}


def _moving(T: Any, name: str) -> Moving:
    found = as_host_numbers(T, name)
    if found.shape not in ((3, 3), (4, 4)) or not np.isfinite(found).all():
        raise ValueError(
            f"{name}: wanted a finite (3, 3) or (4, 4) motion, found {found.shape}."
        )
    check_rigid(found, name, scaled=True)
    return Moving(found)
