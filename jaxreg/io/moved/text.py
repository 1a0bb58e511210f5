"""XYZ, CSV, TXT: cells of coordinates and normals change, in the file's own dialect."""

import itertools
from collections.abc import Iterable, Iterator
from io import BufferedIOBase
from pathlib import Path

from jaxreg.io.files import text_lines
from jaxreg.io.moved import lines
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.columns import NORMALS, named
from jaxreg.io.points.dialect import Dialect, is_comment
from jaxreg.io.points.text import Layout, rows_from


def move_text(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes rows again with as many decimals, comments and heads as they were.

    Cells are separated as before; blanks around them and quotes are not kept.
    """
    layout, start, first = rows_from(text_lines(path), path)
    dialect = layout.dialect
    places = layout.columns[: moving.dim]
    names = named(layout.fields, NORMALS)
    normals = None if names is None else [layout.fields.index(name) for name in names]
    comma = dialect.decimal_comma and any("," in line for line in first)
    form = _form([dialect.cells(line) for line in first], [*places, *(normals or [])])
    moved = lines.move_cells(
        _rows(path, layout, start), moving, places, normals, form.__mod__
    )
    for number, line in text_lines(path):
        if number >= start and line.strip() and not is_comment(line):
            line = _joined(next(moved), dialect, comma)
        out.write((line + "\n").encode("utf-8"))


def _rows(path: Path, layout: Layout, start: int) -> Iterator[list[str]]:
    for number, line in text_lines(path):
        if number >= start and line.strip() and not is_comment(line):
            yield layout.dialect.cells(line)


def _form(rows: list[list[str]], places: Iterable[int]) -> str:
    """The most decimals of the first rows; all digits where exponents are."""
    cells = [row[k] for row, k in itertools.product(rows, places) if k < len(row)]
    if any("e" in cell.lower() for cell in cells):
        return lines.WIDE
    decimals = max((len(cell.partition(".")[2]) for cell in cells), default=0)
    return f"%.{max(decimals, 3)}f"


def _joined(cells: list[str], dialect: Dialect, comma: bool) -> str:
    if comma:
        cells = [cell.replace(".", ",") for cell in cells]
    if dialect.quoted:
        cells = [f'"{cell}"' for cell in cells]
    return (dialect.separator or " ").join(cells)
