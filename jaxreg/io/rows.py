"""Lines of numbers in text files, with errors that name the file and the line."""

from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import text_lines


Line = tuple[int, list[str]]


def read_lines(path: str | Path) -> list[Line]:
    """The words of each line that is not blank or a comment (`#`), with its number.

    Raises:
        InputError: if the file cannot be read as text.
    """
    words = ((k, line.split("#")[0].split()) for k, line in text_lines(path))
    return [(k, row) for k, row in words if row]


def numbers(path: str | Path, line: Line, wanted: int, what: str) -> np.ndarray:
    """The `wanted` finite numbers of a line, float64; `what` names it in messages."""
    number, words = line
    if len(words) != wanted:
        raise InputError(
            f"{path}, line {number}: {what} wants {wanted} numbers, found "
            f"{len(words)}. Is the file cut off?"
        )
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        raise InputError(f"{path}, line {number}: not numbers alone.") from None
    if not np.isfinite(values).all():
        raise InputError(f"{path}, line {number}: holds a number that is not finite.")
    return values


def ids(path: str | Path, line: Line, wanted: int) -> list[int]:
    """The first `wanted` words of a line as integers of at least 0."""
    number, words = line
    found = []
    for word in words[:wanted]:
        if not (word.isascii() and word.isdigit() and len(word) < 19):
            raise InputError(f"{path}, line {number}: {word!r} is not an integer id.")
        found.append(int(word))
    return found
