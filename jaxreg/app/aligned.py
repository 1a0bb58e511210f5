"""Whole scans in the common frame: each file written again, with all that it holds."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.extras import require
from jaxreg.io.files import reading, require_regular
from jaxreg.io.moved.write import write_moved
from jaxreg.io.points.arrays import npz_keys
from jaxreg.io.points.e57 import scan_names
from jaxreg.io.points.read import (
    ARCHIVES,
    point_files,
    split_key,
    stem,
    suffix_of,
    unique_names,
)


class ScanFile(NamedTuple):
    """Where a scan is.

    Attributes:
        name: a unique one.
        file: that it is in.
        key: within an archive, or None.
        state: of the file as it was read (`state_of`); None if that does not matter.
    """

    name: str
    file: Path
    key: str | None
    state: tuple[int, int] | None = None

    @property
    def is_as_read(self) -> bool:
        """Whether the file has not changed since."""
        return self.state is None or self.state == state_of(self.file)


def state_of(file: Path) -> tuple[int, int]:
    """The size in bytes and the time of the last change of a file, in ns."""
    try:
        found = os.stat(file)
    except OSError:
        return -1, -1  # gone
    return found.st_size, found.st_mtime_ns


def list_scans(paths: Sequence[Path]) -> list[ScanFile]:
    """The scans of files, folders and archives, named as `read_scans` does.

    Raises:
        InputError: if a file is missing, or an archive cannot be read.
    """
    found: list[ScanFile] = []
    for path in paths:
        for file in point_files(path):
            found += _scans_of(file)
    names = unique_names([scan.name for scan in found])
    return [x._replace(name=name) for x, name in zip(found, names, strict=True)]


def _scans_of(path: Path) -> Iterator[ScanFile]:
    file, key = split_key(path)
    require_regular(file)
    if suffix_of(file) not in ARCHIVES:
        yield ScanFile(stem(file), file, None)
        return
    keys = [key] if key is not None else keys_of(file)
    alone = len(keys) == 1 and key is None and suffix_of(file) == ".e57"
    for one in keys:
        yield ScanFile(stem(file) if alone else one, file, one)


def scan_file(path: Path, name: str, state: tuple[int, int]) -> ScanFile:
    """Of a scan that `read_named` calls so, of a path with or without a key.

    Args:
        path: the file, with or without a key.
        name: of the scan.
        state: of the file before it was read.
    """
    file, key = split_key(path)
    if suffix_of(file) not in ARCHIVES:
        return ScanFile(name, file, None, state)
    if key is None:
        keys = keys_of(file)
        key = name if name in keys else keys[0]
    return ScanFile(name, file, key, state)


def keys_of(path: Path) -> list[str]:
    """The names of the scans of an archive."""
    with reading(path, suffix_of(path)[1:].upper()):
        if suffix_of(path) == ".npz":
            return npz_keys(path)[0]
        with require("pye57", "Reading E57").E57(str(path)) as file:
            return scan_names(file)


def write_aligned(
    folder: Path, scans: Sequence[ScanFile], motions: Mapping[int, np.ndarray]
) -> list[str]:
    """Writes those that have a motion; scans of an archive into one of its name.

    Args:
        folder: that exists.
        scans: as `list_scans` has them.
        motions: `T_world_i`, `(d+1, d+1)`, by the number of the scan.

    Returns:
        The names of the files.

    Raises:
        InputError: as `write_moved`.
    """
    written: list[str] = []
    archives: dict[Path, dict[str, np.ndarray]] = {}
    for k, T in motions.items():
        name, file, key, _ = scans[k]
        if key is not None:
            archives.setdefault(file, {})[key] = T
            continue
        out = f"{name}{_ending(file)}"
        write_moved(folder / out, file, T)
        written.append(out)
    for file, some in archives.items():
        out = f"{stem(file)}{_ending(file)}"
        if out in written:
            raise InputError(
                f"{file}: two files are called {out}.\nRename one of them."
            )
        write_moved(folder / out, file, some)
        written.append(out)
    return written


def _ending(file: Path) -> str:
    """`.ply.gz` of `A.ply.gz`."""
    packed = ".gz" if file.name.lower().endswith(".gz") else ""
    return Path(file.name[: len(file.name) - len(packed)]).suffix + packed
