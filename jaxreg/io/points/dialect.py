"""How lines of numbers are cut into cells: separators, commas, quotes, names."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxreg.io.errors import InputError


_COMMENT = re.compile(r"\s*(#|//|%)")
_DECIMAL = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_PLAIN = re.compile(r"[-+]?(\d+|nan|inf)([eE][-+]?\d+)?", re.IGNORECASE)
# Thousands marks, two points in one number, exponents of Fortran.
_MISREAD = re.compile(r"[-+]?\d[\d.,'_]*([dDeE][-+]?\d*)?")
# Words around the letter of an axis, as in `Pos X [m]` or `point_x`.
_AROUND = {"p", "pos", "position", "coord", "coordinate", "point", "points", "world"}
_AROUND |= {"m", "mm", "cm", "km", "meter", "metre", "meters", "metres", "in", "local"}
_AXES = {"x": 0, "y": 1, "z": 2}
_HEIGHTS = ("height", "h", "elevation", "elev", "altitude", "alt")


class Dialect(NamedTuple):
    """Separator (None for white space), and what commas and quotes mean."""

    separator: str | None
    decimal_comma: bool = False
    quoted: bool = False

    def cells(self, line: str) -> list[str]:
        """The cells of a line without blanks around them, nor empty ones at its end."""
        if self.quoted:
            if self.separator is None:
                cells = line.replace('"', " ").split()
            else:
                cells = next(csv.reader([line], delimiter=self.separator))
        else:
            cells = line.split(self.separator)
        if self.separator is not None:
            cells = [cell.strip() for cell in cells]
        if self.decimal_comma:
            cells = [cell.replace(",", ".") for cell in cells]
        return cells


def dialect_of(lines: Sequence[str], path: Path | None = None) -> Dialect:
    """The dialect of rows.

    Args:
        lines: the first rows.
        path: for messages; None asks nothing of rows that may be read in two ways.

    Raises:
        InputError: if commas may separate or be decimal.
    """
    quoted = '"' in lines[0]
    for separator in (";", "\t"):
        if separator in lines[0]:
            cells = Dialect(separator, quoted=quoted).cells(lines[0])
            if separator == "\t" and any(len(cell.split()) > 1 for cell in cells):
                continue
            return Dialect(separator, True, quoted)
    if "," not in lines[0]:
        comma = any(_all_decimal(line.split()) for line in lines)
        return Dialect(None, comma, quoted)
    if quoted:
        cells = Dialect(",", quoted=True).cells(lines[0])
        return Dialect(",", any(map(_DECIMAL.fullmatch, cells)), True)
    if _all_decimal(lines[0].split()):
        return Dialect(None, True)
    if path is not None:
        _require_separating(lines, path)
    return Dialect(",")


def _all_decimal(words: list[str]) -> bool:
    """Whether commas within words of numbers can only be decimal."""
    found = [bool(_DECIMAL.fullmatch(word)) for word in words]
    return (
        len(words) > 1
        and any(found)
        and all(a or "," not in word for a, word in zip(found, words, strict=True))
    )


def _require_separating(lines: Sequence[str], path: Path) -> None:
    """Refuses `1,50,2,05,3,00`: three numbers, or six."""
    rows = [line.replace(" ", "").split(",") for line in lines]
    width = len(rows[0])
    if width not in (4, 6) or any(len(row) != width for row in rows):
        return
    if not all(_PLAIN.fullmatch(cell) for row in rows for cell in row):
        return
    ends = [cell for row in rows for cell in row[1::2]]
    if not all(cell.isdigit() for cell in ends):
        return
    padded = any(len(cell) > 1 and cell[0] == "0" for cell in ends)
    even = len({len(cell) for cell in ends}) == 1 and len(ends[0]) >= 3
    if padded or even:
        raise InputError(
            f"{path}: commas may separate its numbers or be decimal, as in "
            f"{lines[0].strip()[:40]!r}.\n"
            "Write decimal points, or separate by semicolons or tabulators."
        )


def is_comment(line: str) -> bool:
    """Whether a line is one."""
    return _COMMENT.match(line) is not None


def is_number(cell: str) -> bool:
    """Whether a cell is a number, NaN and inf included."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def misread(cell: str) -> bool:
    """Whether a cell looks like a number but is none, such as 1.234,5 or 1.5D+03."""
    return _MISREAD.fullmatch(cell) is not None and not is_number(cell)


def coordinates(
    names: list[str], numeric: list[int], width: int, path: Path
) -> tuple[list[int], tuple[str, ...]]:
    """The columns of the coordinates and the names of all, if there are any.

    Names win over places.

    Args:
        names: the words of the line above the rows.
        numeric: the columns of numbers.
        width: columns in all.
        path: for messages only.

    Raises:
        InputError: if the names contradict the rows, or name more than three columns of
            numbers but no coordinates.
    """
    if len(numeric) < 2:
        raise InputError(
            f"{path}: found rows with fewer than two numbers.\n"
            "Wanted one point a line: x y z or x y, after at most one header line."
        )
    axes = _axes(names)
    if len(names) != width:
        # `x y z` before colours that have no names is usual.
        usual = list(axes.values()) == list(range(min(3, len(numeric))))
        if {"x", "y"} <= axes.keys() and not usual:
            raise InputError(
                f"{path}: has {width} columns, but names {len(names)}: "
                f"{' '.join(names)[:60]!r}.\nName each column once, or none."
            )
        return numeric[:3], ()
    if any(map(is_number, names)):
        return numeric[:3], ()
    if not {"x", "y"} <= axes.keys():
        if len(numeric) > 3:
            raise InputError(
                f"{path}: names its columns {' '.join(names)[:60]!r}, none x and y.\n"
                "Name the coordinates x, y, z, or remove the line of names."
            )
        return numeric[:3], tuple(names)
    columns = [axes[a] for a in "xyz" if a in axes]
    wrong = [k for k in columns if k not in numeric]
    if wrong:
        raise InputError(
            f"{path}: the column {names[wrong[0]]!r} holds no numbers.\n"
            "Correct the line of names."
        )
    return columns, tuple(names)


def _axes(names: list[str]) -> dict[str, int]:
    """The columns that x, y and z name; plain names before those with words around."""
    found: dict[str, int] = {}
    lower = [name.strip().strip("\"'").lower() for name in names]
    for axis in "xyz":
        plain = [k for k, name in enumerate(lower) if name == axis]
        around = [k for k, name in enumerate(lower) if _axis(name) == axis]
        if plain or around:
            found[axis] = (plain or around)[0]
    if {"x", "y"} <= found.keys() and "z" not in found:
        heights = [k for k, name in enumerate(lower) if name in _HEIGHTS]
        if heights:
            found["z"] = heights[0]
    return found


def _axis(name: str) -> str | None:
    words = re.findall(r"[a-z]+|\d+", name)
    left = [word for word in words if word not in _AROUND]
    if len(left) != 1:
        return None
    if left[0] in ("0", "1", "2") and len(words) == 2:  # Points:0 of ParaView
        return "xyz"[int(left[0])]
    return left[0] if left[0] in _AXES else None
