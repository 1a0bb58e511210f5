"""Point sets as text: XYZ, CSV, TXT in the dialects that scanners and sheets write.

By hand: `numpy.loadtxt` knows neither decimal commas nor empty cells, and says neither
file nor what to do.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.points.dialect import (
    Dialect,
    coordinates,
    dialect_of,
    is_comment,
    is_number,
    misread,
)
from jaxreg.io.points.other_text import require_points


_LOOK = 50  # rows that the layout is read from
_X_Y_Z_COLORS = ("x", "y", "z", "red", "green", "blue")
Line = tuple[int, str]


class Layout(NamedTuple):
    """What the first lines say.

    Attributes:
        dialect: how a line is cut into cells.
        columns: of the coordinates.
        fields: names of all columns, empty if the file has none.
        width: cells of the first row.
        needed: cells that every row must have: up to the last column of numbers.
        promised: rows, as a line before them says, None without one.
    """

    dialect: Dialect
    columns: list[int]
    fields: tuple[str, ...]
    width: int
    needed: int
    promised: int | None


def parse_text(
    lines: Iterable[Line], path: Path, step: int = 1
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The points of a text file, `(n, d)` float64, and the names of its columns.

    The separator is read from the first rows: a semicolon, else a comma or tabulators,
    else white space; commas are decimal where they can be nothing else. Lines that
    start with `#`, `//` or `%` are comments; before the numbers there may be a header,
    whose names x, y, z tell the coordinates, and the number of rows. Without names the
    first three columns of numbers are taken, or two if there are but two. An empty cell
    is NaN.

    Args:
        lines: with their numbers in the file.
        path: for messages only.
        step: of so many rows one is parsed.

    Raises:
        InputError: if a row does not hold the numbers that the first ones promise, if
            there are not as many as said, or if the file holds something else: poses,
            a graph, a mesh.
    """
    lines = iter(lines)
    first, heads = _first_lines(lines)
    layout, first = _layout(first, heads, path)
    rest = (line for line in lines if line[1].strip() and not is_comment(line[1]))
    counted = _Counted(itertools.chain(first, rest))
    kept = itertools.islice(counted, 0, None, step)
    rows = (_parse_row(line, layout, path) for line in kept)
    points = np.fromiter(rows, dtype=(np.float64, len(layout.columns)))
    if layout.promised is not None and layout.promised != counted.number:
        raise InputError(
            f"{path}: says that it has {layout.promised} points, but holds "
            f"{counted.number}. Is it cut off?\nExport or copy the scan again."
        )
    return points, layout.fields


def rows_from(lines: Iterable[Line], path: Path) -> tuple[Layout, int, list[str]]:
    """The layout of a text file, the number of its first row, and the first rows.

    Raises:
        InputError: as `parse_text`.
    """
    layout, rows = _layout(*_first_lines(iter(lines)), path)
    return layout, rows[0][0], [line for _, line in rows]


def may_be_points(lines: Iterable[Line], path: Path) -> bool:
    """Whether half of the first lines have numbers, not plainly of poses or a graph.

    True also of what is no text at all: the reader says what is wrong.
    """
    try:
        found, _ = _first_lines(iter(lines))
    except InputError:
        return True
    try:
        require_points([line for _, line in found], path)
    except InputError:
        return False
    numbers = sum(_has_numbers(line) for _, line in found)
    return 0 < len(found) <= 2 * numbers


def parse_columns(
    lines: Iterable[Line], path: Path, names: Sequence[str], step: int
) -> np.ndarray:
    """The columns of these names, `(n, k)` float64, of one of so many rows."""
    lines = iter(lines)
    layout, first = _layout(*_first_lines(lines), path)
    layout = layout._replace(columns=[layout.fields.index(name) for name in names])
    rest = (line for line in lines if line[1].strip() and not is_comment(line[1]))
    kept = itertools.islice(itertools.chain(first, rest), 0, None, step)
    rows = [_parse_row(line, layout, path) for line in kept]
    return np.array(rows, np.float64).reshape(-1, len(names))


class _Counted:
    """An iterator that knows how many lines passed."""

    def __init__(self, lines: Iterator[Line]):
        self._lines, self.number = lines, 0

    def __iter__(self) -> "_Counted":
        return self

    def __next__(self) -> Line:
        line = next(self._lines)
        self.number += 1
        return line


def _first_lines(lines: Iterator[Line]) -> tuple[list[Line], list[str]]:
    """The first lines that are no comments, and the comments before them."""
    found: list[Line] = []
    comments: list[str] = []
    for number, line in lines:
        if not line.strip():
            continue
        if not is_comment(line):
            found.append((number, line))
        elif not found:
            comments.append(line.strip().lstrip("#/% "))
        if len(found) > _LOOK:
            break
    return found, comments[-1:]


def _layout(
    lines: list[Line], heads: list[str], path: Path
) -> tuple[Layout, list[Line]]:
    """What the lines say, and those that are rows."""
    require_points([line for _, line in lines], path)
    count: int | None = None
    commented = True
    for number, line in lines[:2]:
        if line.count('"') % 2:
            raise InputError(
                f"{path}, line {number}: a quotation mark that nothing closes.\n"
                "Write each row on a line of its own."
            )
    for _ in range(2):
        start = lines[0][1].strip() if lines else ""
        if count is None and start.isascii() and start.isdigit() and len(lines) > 1:
            count = int(start)
            lines = lines[1:]
        elif lines and not _has_numbers(lines[0][1]):
            heads, commented = [lines[0][1].strip()], False
            lines = lines[1:]
    if not lines or not _has_numbers(lines[0][1]):
        raise InputError(
            f"{path}: found no line with two or three numbers.\n"
            "Wanted one point a line: x y z or x y, after at most one header line."
        )
    dialect = dialect_of([line for _, line in lines], path)
    rows = [dialect.cells(line) for _, line in lines]
    numeric = _numeric_columns(rows, lines, path)
    names = dialect.cells(heads[0]) if heads else []
    if commented and len(names) != len(rows[0]):
        names = []  # a comment like any other
    columns, fields = coordinates(names, numeric, len(rows[0]), path)
    fields = fields or _by_their_values(rows)
    _require_first_row(rows, columns, lines, path)
    needed = max(numeric) + 1
    return Layout(dialect, columns, fields, len(rows[0]), needed, count), lines


def _has_numbers(line: str) -> bool:
    return sum(map(is_number, dialect_of([line]).cells(line))) >= 2


def _by_their_values(rows: list[list[str]]) -> tuple[str, ...]:
    """Names of six columns without any, of which three plainly are colours."""
    if any(len(row) != 6 for row in rows):
        return ()
    cells = [cell for row in rows for cell in row[3:]]
    if not all(cell.isascii() and cell.isdigit() for cell in cells):
        return ()
    # Of zeros and ones alone they may be normals.
    return _X_Y_Z_COLORS if 1 < max(map(int, cells)) <= 255 else ()


def _numeric_columns(rows: list[list[str]], lines: list[Line], path: Path) -> list[int]:
    """The columns of numbers, by the first row that has something there."""
    found = []
    for k in range(len(rows[0])):
        cells = (row[k] for row in rows if len(row) > k and row[k])
        cell = next(cells, "")
        if is_number(cell):
            found.append(k)
        elif misread(cell):
            raise InputError(
                f"{path}, line {lines[0][0]}: {cell!r} is no number as it stands.\n"
                "Write numbers with a decimal point and without other marks."
            )
    return found


def _require_first_row(
    rows: list[list[str]], columns: list[int], lines: list[Line], path: Path
) -> None:
    """Refuses a first row that is shorter than the others or has a word in it."""
    width = len(rows[0])
    between = range(columns[0], columns[-1]) if len(columns) > 2 else range(width)
    words = [k for k in between if rows[0][k] and not is_number(rows[0][k])]
    for row in rows[1:]:
        if any(map(is_number, row[width:])) or any(is_number(row[k]) for k in words):
            raise InputError(
                f"{path}, line {lines[0][0]}: holds fewer numbers than the rows below "
                f"it: {lines[0][1].strip()[:60]!r}.\nCorrect or remove the line."
            )


def _parse_row(line: Line, layout: Layout, path: Path) -> list[float]:
    number, text = line
    cells = layout.dialect.cells(text)
    try:
        if len(cells) != layout.width:
            _require_width(cells, layout)
        if "_" in text and any("_" in cells[c] for c in layout.columns):
            raise ValueError
        return [float(cells[c]) if cells[c] else np.nan for c in layout.columns]
    except (ValueError, IndexError) as err:
        raise InputError(
            f"{path}, line {number}: wanted {layout.width} cells with "
            f"{len(layout.columns)} numbers, found {text.strip()[:60]!r}.\n"
            "Correct or remove the line."
        ) from err


def _require_width(cells: list[str], layout: Layout) -> None:
    """Rows may differ in words behind the numbers, not in numbers.

    Raises:
        ValueError: otherwise.
    """
    if any(map(is_number, cells[layout.width :])) or not any(cells):
        raise ValueError
    if len(cells) < layout.needed:
        raise ValueError
