"""Every so many rows of files that hold more than is wanted."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias


#: From the number of rows of a file to the distance of those that are kept.
Step: TypeAlias = Callable[[int], int]

# Parsed text takes some thirty times its size.
_MOST_TEXT = 100_000_000
_HEAD = 100


def every_row(num: int) -> int:
    """All rows."""
    del num
    return 1


def at_most(max_points: int) -> Step:
    """The least distance that keeps at most so many rows."""
    return lambda num: max(1, -(-num // max_points))


def some_lines(path: Path) -> tuple[bytes, int]:
    """The first lines of a text file and every so many of the others, and how many.

    Raises:
        OSError: if the file cannot be read.
    """
    step = -(-path.stat().st_size // _MOST_TEXT)
    with path.open("rb") as file:
        head = list(itertools.islice(file, _HEAD))
        return b"".join([*head, *itertools.islice(file, 0, None, step)]), step
