"""Point sets as text: XYZ, CSV, TXT in the dialects that scanners and sheets write.

By hand: `numpy.loadtxt` knows neither decimal commas nor empty cells, and says neither
file nor what to do.
"""

import re
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError


_COMMENT = re.compile(r"\s*($|#|//|%)")


def parse_text(data: bytes, path: Path) -> np.ndarray:
    """The points of a text file, `(n, d)` float64; `path` is for messages only.

    The separator is read from the first line of numbers: a semicolon (then commas are
    decimal), else a comma, else white space. Lines that start with `#`, `//` or `%` are
    comments; one line before the numbers may be a header or a count. An empty cell is
    NaN.

    Raises:
        InputError: if a line does not hold the numbers that the first one promises.
    """
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as err:
        raise InputError(
            f"{path}: not a text file.\nGive it the suffix of its true format."
        ) from err
    numbered = [(k + 1, s) for k, s in enumerate(lines) if not _COMMENT.match(s)]
    start = _first_row(numbered, path)
    separator = _separator(numbered[start][1])
    columns = _numeric_columns(numbered[start][1], separator)[:3]
    rows = (_parse_row(s, separator, columns, k, path) for k, s in numbered[start:])
    return np.fromiter(rows, dtype=(np.float64, len(columns)))


def columns(data: bytes) -> tuple[str, ...]:
    """The words of the header line of a text file, if it has one for every column."""
    lines = data[:100_000].decode("utf-8-sig", errors="replace").splitlines()
    head, *rest = [s for s in lines if not _COMMENT.match(s)][:2]
    if not rest:
        return ()
    separator = _separator(rest[0])
    words = [cell.strip() for cell in _cells(head, separator)]
    named = len(words) == len(_cells(rest[0], separator))
    return tuple(words) if named and not any(map(_is_number, words)) else ()


def _first_row(numbered: list[tuple[int, str]], path: Path) -> int:
    for k, (_, line) in enumerate(numbered[:2]):
        if len(_numeric_columns(line, _separator(line))) >= 2:
            return k
    raise InputError(
        f"{path}: found no line with two or three numbers.\n"
        "Wanted one point a line: x y z or x y, after at most one header line."
    )


def _separator(line: str) -> str | None:
    return ";" if ";" in line else "," if "," in line else None


def _cells(line: str, separator: str | None) -> list[str]:
    if separator == ";":
        line = line.replace(",", ".")
    return line.split(separator)


def _numeric_columns(line: str, separator: str | None) -> list[int]:
    return [k for k, cell in enumerate(_cells(line, separator)) if _is_number(cell)]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _parse_row(
    line: str, separator: str | None, columns: list[int], number: int, path: Path
) -> list[float]:
    cells = _cells(line, separator)
    try:
        return [float(cells[c]) if cells[c].strip() else np.nan for c in columns]
    except (ValueError, IndexError) as err:
        raise InputError(
            f"{path}, line {number}: wanted {len(columns)} numbers, found "
            f"{line.strip()[:60]!r}.\nCorrect or remove the line."
        ) from err
