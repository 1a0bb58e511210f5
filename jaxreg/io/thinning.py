"""Every so many rows of files that hold more than is wanted."""

import gzip
import io
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias


#: From the number of rows of a file to the distance of those that are kept.
Step: TypeAlias = Callable[[int], int]

# Parsed text takes some thirty times its size.
_MOST_TEXT = 100_000_000
_HEAD = 100
_BLOCK = 1 << 24


def every_row(num: int) -> int:
    """All rows."""
    del num
    return 1


def at_most(max_points: int) -> Step:
    """The least distance that keeps at most so many rows."""
    return lambda num: max(1, -(-num // max_points))


def is_packed(path: Path) -> bool:
    """Whether the name says that the file is compressed."""
    return path.name.lower().endswith(".gz")


def open_bytes(path: Path) -> gzip.GzipFile | io.BufferedReader:
    """The file, unpacked if it is compressed."""
    return gzip.open(path) if is_packed(path) else path.open("rb")


def some_lines(path: Path) -> tuple[bytes, int]:
    """The first lines of a text file and every so many of the others, and how many.

    A compressed file is unpacked twice, block by block: its size is not known before.

    Raises:
        OSError, EOFError, zlib.error: if the file cannot be read.
    """
    if is_packed(path):
        with open_bytes(path) as file:
            size = sum(map(len, iter(lambda: file.read(_BLOCK), b"")))
    else:
        size = path.stat().st_size
    step = -(-size // _MOST_TEXT)
    with open_bytes(path) as file:
        head = list(itertools.islice(file, _HEAD))
        return b"".join([*head, *itertools.islice(file, 0, None, step)]), step
