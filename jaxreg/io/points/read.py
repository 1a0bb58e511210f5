"""Reading point sets: one entry point that goes by the suffix of the file."""

import os
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import is_packed, open_bytes, reading, require_regular, text_lines
from jaxreg.io.points import arrays, e57, kitti, las, meshes, pcd, ply, text
from jaxreg.io.points.content import require_suffix
from jaxreg.io.points.other_text import OF_POSES, refusal
from jaxreg.io.points.thinning import Step, at_most, every_row, text_step
from jaxreg.io.printable import printable


TEXT = (".xyz", ".csv", ".txt", ".pts", ".asc")
_PARSERS = {
    ".npy": arrays.parse_npy,
    ".ply": ply.parse_ply,
    ".pcd": pcd.parse_pcd,
    ".bin": kitti.parse_bin,
    ".las": las.parse_las,
    ".laz": las.parse_las,
    ".obj": meshes.parse_obj,
    ".stl": meshes.parse_stl,
}
ARCHIVES = (".npz", ".e57")
SUFFIXES = (*_PARSERS, *ARCHIVES, *TEXT)
_NEVER_PACKED = (".npy", *ARCHIVES, "")
_FORMATS = (
    "PLY, XYZ/CSV/TXT text, PCD, LAS/LAZ, OBJ, STL, KITTI's .bin (each also .gz), "
    "E57, NPY, NPZ"
)


class NamedPoints(NamedTuple):
    """Points as read.

    Attributes:
        points: `(n, d)` float32 or float64, rows with NaN or inf included.
        fields: names of the columns or properties of the file, empty if it has none.
        step: of how many rows of the file one was kept.
    """

    points: np.ndarray
    fields: tuple[str, ...] = ()
    step: int = 1


def read_points(path: str | Path) -> np.ndarray:
    """Reads one point set.

        >>> import numpy as np, pathlib, tempfile
        >>> from jaxreg import io
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "corner.ply"
        >>> io.write_ply(path, np.eye(3, dtype=np.float32))
        >>> io.read_points(path)
        array([[1., 0., 0.],
               [0., 1., 0.],
               [0., 0., 1.]], dtype=float32)

    PLY (binary or ASCII), PCD, LAS, LAZ, KITTI's `.bin` (float32 x y z intensity), the
    vertices of OBJ and STL, and text files; all of these may be compressed (`.gz`).
    Text is separated by commas, semicolons or white space; the columns that a header
    line names x, y, z are taken, without one the first three of numbers, or both if
    there are two. NPY, NPZ and E57; one scan of an NPZ or E57 file that holds several
    is named as `FILE.npz:KEY`.

    Args:
        path: the file.

    Returns:
        `(n, d)` array, d = 2 or 3, float32 if the file holds float32, else float64 (as
        for LAS, LAZ and E57), in the unit of the file. Rows with NaN or inf are kept.

    Raises:
        InputError: if the file is missing, unreadable, empty, or holds no points.
        MissingExtraError: if the package of the extra `formats` that reads this kind is
            not installed.
    """
    bare, key = split_key(path)
    scans = read_named(path)
    if len(scans) > 1:
        raise InputError(
            f"{bare}: holds {len(scans)} scans: {arrays.some_of(list(scans))}.\n"
            f"Name one of them, for example {bare}:{next(iter(scans))}"
        )
    return next(iter(scans.values())).points


def read_scans(
    paths: str | Path | Iterable[str | Path],
) -> tuple[list[str], list[np.ndarray]]:
    """Reads scans from files, NPZ archives and folders, in the order given.

    Args:
        paths: each is a file as for `read_points`, an NPZ or E57 file of which every
            scan is read, or a folder, of which all point files are read in natural
            order (`scan2` before `scan10`). Of text files there without points, such
            as a readme or poses, and of arrays that are no scans, a warning tells
            that they are skipped.

    Returns:
        Names, made of file names without suffix or NPZ keys and unique, and as many
        `(n_i, d)` arrays.

    Raises:
        InputError: as `read_points`, and if a folder holds no point file.
    """
    names: list[str] = []
    scans: list[np.ndarray] = []
    for path in [paths] if isinstance(paths, (str, Path)) else paths:
        for note in notes_on_skipped(path):
            warnings.warn(note, stacklevel=2)
        for file in point_files(path):
            found = read_named(file)
            names += found.keys()
            scans += [scan.points for scan in found.values()]
    return unique_names(names), scans


def read_named(
    path: str | Path, max_points: int | None = None
) -> dict[str, NamedPoints]:
    """Reads all scans of one file by name, that of the file if there is but one.

    Args:
        path: a file as for `read_points`, an archive with or without `:KEY`.
        max_points: of scans with more, every so many rows are kept. The others never
            are in memory together, but for compressed files (`.gz` that is not text,
            `binary_compressed` PCD) and meshes that are text.

    Raises:
        InputError: as `read_points`.
    """
    bare, key = split_key(path)
    if suffix_of(bare) not in ARCHIVES:
        return {stem(bare): _read_file(bare, max_points)}
    step = every_row if max_points is None else at_most(max_points)
    found = _read_archive(bare, step, key)
    scans = {name: _thinned(scan, max_points) for name, scan in found.items()}
    if key is None and len(scans) == 1 and suffix_of(bare) == ".e57":
        return {stem(bare): next(iter(scans.values()))}  # scanners name all alike
    if key is not None and key not in scans:
        listing = arrays.some_of(list(scans))
        raise InputError(f"{bare}: has no scan {key}.\nIt holds: {listing}.")
    return scans if key is None else {key: scans[key]}


def point_files(path: str | Path) -> list[Path]:
    """The point files of a folder in natural order; a file stands for itself.

    Text files of something else, such as a readme, are left out, see `prose_files`.

    Raises:
        InputError: if a folder holds no point file.
    """
    path = Path(path)
    if not path.is_dir():
        return [path]
    prose = prose_files(path)
    files = [f for f in _candidates(path) if f not in prose]
    if not files:
        raise InputError(
            f"{path}: the folder holds no point files.\nWanted {_FORMATS}."
        )
    return files


def prose_files(path: str | Path) -> list[Path]:
    """The text files of a folder that are none of points; none of a file.

    Those that are not rows of numbers, such as a readme, and those that plainly hold
    poses or a graph. An empty one counts if it ends in `.txt`; with another suffix it
    may be a scan that was not exported whole.

    Raises:
        InputError: if the folder cannot be read.
    """
    if not Path(path).is_dir():
        return []
    found = [f for f in _candidates(Path(path)) if suffix_of(f) in TEXT]
    found = [f for f in found if f.stat().st_size or suffix_of(f) == ".txt"]
    return [f for f in found if not text.may_be_points(text_lines(f), f)]


def notes_on_skipped(path: str | Path) -> list[str]:
    """Which files of a folder and which arrays of an NPZ file are no scans."""
    notes = [f"{file}: holds no points, skipped." for file in prose_files(path)]
    for file in point_files(path):
        if suffix_of(file) == ".npz" and file.is_file():
            scans, others = arrays.npz_keys(file)
            if scans and others:
                notes.append(f"{file}: no scans, skipped: {arrays.some_of(others)}.")
    return notes


def _candidates(folder: Path) -> list[Path]:
    """Files of a folder whose suffix is one of points, in natural order."""
    with reading(folder, "folder", "Check its name and permissions."):
        files = [
            f
            for f in folder.iterdir()
            if f.is_file() and not f.name.startswith(".") and suffix_of(f) in SUFFIXES
        ]
    return sorted(files, key=lambda f: _natural(f.name))


def stem(path: str | Path) -> str:
    """The name of a file without its folder and without `.ply`, `.ply.gz` and such.

    Bytes that are no UTF-8 are spelled out in ASCII, so that the name can be written.
    """
    name = os.fsencode(Path(path).name).decode("utf-8", "backslashreplace")
    name = name[:-3] if name.lower().endswith(".gz") else name
    return name[: -len(Path(name).suffix)] if Path(name).suffix else name


def _read_file(path: Path, max_points: int | None) -> NamedPoints:
    suffix = suffix_of(path)
    require_known(path, suffix)
    if suffix in TEXT:
        # Of packed text always: it is unpacked in no time, but parsed in much.
        step = text_step(path) if max_points is not None or is_packed(path) else 1
        step = step if max_points is not None else 1
        with reading(path, "text"):
            points, fields = text.parse_text(text_lines(path), path, step)
        found = NamedPoints(points, fields, step)
    else:
        data = _unpacked(path) if is_packed(path) else None
        step = every_row if max_points is None else at_most(max_points)
        with reading(path, suffix[1:].upper()):
            found = NamedPoints(*_PARSERS[suffix](data, path, step))
    return _thinned(found, max_points)


def _thinned(scan: NamedPoints, max_points: int | None) -> NamedPoints:
    step = 1 if max_points is None else at_most(max_points)(len(scan.points))
    points = scan.points if step == 1 else scan.points[::step].copy()
    return scan._replace(points=points, step=step * scan.step)


def _read_archive(path: Path, step: Step, key: str | None) -> dict[str, NamedPoints]:
    suffix = suffix_of(path)
    require_known(path, suffix)
    with reading(path, suffix[1:].upper()):
        if suffix == ".npz":
            found = arrays.parse_npz(path, step, key)
        else:
            found = e57.read_e57(path, step)
    return {name: NamedPoints(*scan) for name, scan in found.items()}


def require_known(path: Path, suffix: str) -> None:
    """Refuses what is no file of points before it is read.

    Raises:
        InputError: for no regular file, an empty one, an unknown suffix, or one that
            the content belies.
    """
    require_regular(path)
    if suffix in OF_POSES:
        raise refusal(path, *OF_POSES[suffix])
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: unknown kind of file {suffix or '(no suffix)'}.\n"
            f"Wanted {_FORMATS}."
        )
    with open_bytes(path) as file:
        start = file.read(16)
    if not start:
        raise InputError(f"{path}: the file is empty.\nExport or copy the scan again.")
    require_suffix(start, suffix, path)


def _unpacked(path: Path) -> bytes:
    with reading(path, "gzip"), open_bytes(path) as file:
        return file.read()


def split_key(path: str | Path) -> tuple[Path, str | None]:
    """The file and the key of `FILE.npz:KEY`; None without one."""
    match = re.fullmatch(r"(.*\.(?:npz|e57)):([^/\\]+)", str(path), re.IGNORECASE)
    return (Path(match[1]), match[2]) if match else (Path(path), None)


def suffix_of(path: Path) -> str:
    """In lower case, that within of a packed file: `.ply` of `A.PLY.gz`."""
    name = path.name.lower()
    packed = name.endswith(".gz")
    suffix = Path(name[:-3] if packed else name).suffix
    return suffix + ".gz" if packed and suffix in _NEVER_PACKED else suffix


def _natural(name: str) -> list[tuple[int, int | str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(p)) if p.isdigit() else (1, p) for p in parts if p]


def unique_names(names: list[str]) -> list[str]:
    """The same names, printable, later ones of a kind with -2, -3 ... appended."""
    seen: dict[str, int] = {}
    out: list[str] = []
    for name in map(printable, names):
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}-{seen[name]}")
    return out
