"""Every so many rows of files that hold more than is wanted."""

import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from jaxreg.io.files import is_packed, open_bytes


#: From the number of rows of a file to the distance of those that are kept.
Step: TypeAlias = Callable[[int], int]

# Parsed text takes some thirty times its size.
_MOST_TEXT = 100_000_000
_BLOCK = 1 << 24
_LONGEST_LINE = 1_000_000
_ROWS = 1_000_000  # that are read at a time


def every_row(num: int) -> int:
    """All rows."""
    del num
    return 1


def at_most(max_points: int) -> Step:
    """The least distance that keeps at most so many rows."""
    return lambda num: max(1, -(-num // max_points))


def text_step(path: Path) -> int:
    """Of how many lines of a text file one is parsed, if that is to be done soon.

    A compressed file is unpacked for it: its size is not known before.

    Raises:
        InputError: if the file cannot be read.
    """
    if is_packed(path):
        with open_bytes(path) as file:
            size = sum(map(len, iter(lambda: file.read(_BLOCK), b"")))
    else:
        size = path.stat().st_size
    return -(-size // _MOST_TEXT)


def byte_lines(file: io.BufferedIOBase) -> Iterator[bytes]:
    """Lines of an open file; one without end comes in parts, so that memory holds."""
    return iter(lambda: file.readline(_LONGEST_LINE), b"")


def records(file: Any, num: int, dtype: np.dtype, every: int) -> np.ndarray:
    """One of every so many of the next records of a binary file, read by blocks.

    Raises:
        EOFError: if the file ends before.
    """
    parts = []
    block = every * max(1, _ROWS // every)
    for start in range(0, num, block):
        count = min(block, num - start)
        data = file.read(count * dtype.itemsize)
        if len(data) < count * dtype.itemsize:
            raise EOFError("cut off")
        parts.append(np.frombuffer(data, dtype)[::every].copy())
    return np.concatenate(parts) if parts else np.zeros(0, dtype)


def number_rows(lines: Iterable[bytes], places: Sequence[int]) -> np.ndarray:
    """The numbers at these places of lines of words, `(n, len(places))` float64.

    Raises:
        ValueError: if a line has no number there.
    """
    lines = iter(lines)
    first = list(itertools.islice(lines, 1))
    if not first:
        return np.zeros((0, len(places)))
    every_line = itertools.chain(first, lines)
    return np.loadtxt(every_line, usecols=places, ndmin=2)
