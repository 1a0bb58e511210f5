"""`ScanSet`s in one file each, whose arrays are mapped and not copied."""

import dataclasses
import pickle
import sys
from pathlib import Path
from typing import IO

import jax
import numpy as np

from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.multiview import ScanSet
from jaxreg.multiview.mapped_file import read_tree, write_tree


_MARK = b"jaxreg scan set\n"
# What unpickling raises of bytes that are no pickle, or of classes that are not there.
_DAMAGED = (
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ImportError,
    MemoryError,
)


def write_scan_set(path: str | Path, scans: ScanSet) -> None:
    """Keeps a set for another process; the file appears whole or not at all.

    Args:
        path: of the file, with any suffix.
        scans: the set, some megabytes a scan.

    Raises:
        InputError: if the folder cannot be written.
    """
    with atomic_write(path, "wb") as file:
        file.write(_MARK + _version())
        write_tree(file, jax.tree.map(np.asarray, scans))


def read_scan_set(path: str | Path) -> ScanSet:
    """Reads what `write_scan_set` wrote, by the same version of jaxreg.

    On a CPU its arrays stay in the file, which several processes share; who reads a
    file goes on to see it where it is replaced or removed meanwhile, on Linux. It holds
    a pickle, which can run any code: read what you trust alone.

    Args:
        path: of the file.

    Raises:
        InputError: if it cannot be read, is no such file, or of another version.
    """
    try:
        with open(path, "rb") as file:
            _check_head(file, path)
            found = _read(file, path)
    except OSError as err:
        raise InputError(f"{path}: cannot be read ({err.strerror}).") from err
    # Origins stay in NumPy: their float64 is more than JAX may hold.
    ready = jax.device_put((found.method, found.scans))
    return dataclasses.replace(found, method=ready[0], scans=ready[1])


def _check_head(file: IO[bytes], path: str | Path) -> None:
    if file.readline(len(_MARK)) != _MARK:
        raise InputError(f"{path}: is no file of jaxreg.io.write_scan_set.")
    version = file.readline(100)
    if version != _version():
        raise InputError(
            f"{path}: is of jaxreg {version.decode(errors='replace').strip()}, this is "
            f"{_version().decode().strip()}.\nMake the set again from the scans."
        )


def _read(file: IO[bytes], path: str | Path) -> ScanSet:
    try:
        found = read_tree(file)
    except _DAMAGED as err:
        raise InputError(f"{path}: is damaged ({err}).") from err
    if not isinstance(found, ScanSet):
        raise InputError(f"{path}: is damaged (it holds no ScanSet).")
    return found


def _version() -> bytes:
    """A line; the package imports this file."""
    return f"{sys.modules['jaxreg'].__version__}\n".encode()
