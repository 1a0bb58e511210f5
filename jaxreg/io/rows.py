"""Lines of numbers in text files, with errors that name the file and the line."""

import gzip
import zlib
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError


Line = tuple[int, list[str]]


def text_lines(path: str | Path) -> list[str]:
    """The lines of a text file of poses or motions, unpacked if it ends in `.gz`.

    Raises:
        InputError: if the file cannot be read as text.
    """
    packed = str(path).lower().endswith(".gz")
    try:
        with (gzip.open if packed else open)(path, "rt", encoding="utf-8") as file:
            return file.read().splitlines()
    except UnicodeDecodeError as err:
        raise InputError(
            f"{path}: not a text file.\n"
            "Give poses or a pose graph; scans go to: jaxreg multiview"
        ) from err
    except (OSError, EOFError, zlib.error) as err:
        reason = getattr(err, "strerror", None) or err
        raise InputError(
            f"{path}: cannot be read ({reason}).\nCheck the name and the permissions."
        ) from err


def read_lines(path: str | Path) -> list[Line]:
    """The words of each line that is not blank or a comment (`#`), with its number.

    Raises:
        InputError: if the file cannot be read as text.
    """
    lines = text_lines(path)
    words = [(k, line.split("#")[0].split()) for k, line in enumerate(lines, start=1)]
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
        if not (word.isascii() and word.isdigit()):
            raise InputError(f"{path}, line {number}: {word!r} is not an integer id.")
        found.append(int(word))
    return found
