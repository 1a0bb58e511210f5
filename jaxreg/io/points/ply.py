"""Reading PLY files, binary and ASCII."""

import io
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import reading
from jaxreg.io.points.ply_layout import Element, Header, end_of, read_header
from jaxreg.io.points.thinning import Step, byte_lines, every_row, number_rows


def parse_ply(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The vertices of a PLY file.

    Args:
        data: its content; None maps the file into memory, so that of a large binary
            one only the rows that are kept are read into it.
        path: of the file, and for messages.
        step: tells from the number of rows which of them to keep.

    Returns:
        `(n, d)` float32 unless the file stores float64 coordinates, 2D if the vertices
        have no property z; the names of the properties of a vertex; of how many
        vertices one was kept.

    Raises:
        InputError: if the data are no PLY file, hold no vertices, or hold more or less
            than the header says.
    """
    with reading(path, "PLY", "Export the scan again, as PLY or as text."):
        size = path.stat().st_size if data is None else len(data)
        with path.open("rb") if data is None else io.BytesIO(data) as file:
            header = read_header(file, size)
            before, vertex = header.before_and_vertex()
            names = coordinates(vertex)
            every = step(max(vertex.num, 1))
            columns = _columns(file, path, data, header, names, every)
    if len(columns[0]) == 0:
        raise InputError(f"{path}: holds no points.\nExport or copy the scan again.")
    types = {p.name: np.dtype(p.type) for p in vertex.properties}
    wide = any(types[a].kind != "f" or types[a].itemsize > 4 for a in names)
    points = np.stack(columns, axis=1).astype(np.float64 if wide else np.float32)
    return points, tuple(types), every


def read_columns(
    data: bytes | None, path: Path, names: list[str], every: int
) -> list[np.ndarray]:
    """Properties of one of so many vertices, in their types; text as float64."""
    size = path.stat().st_size if data is None else len(data)
    with path.open("rb") if data is None else io.BytesIO(data) as file:
        return _columns(file, path, data, read_header(file, size), names, every)


def _columns(
    file: io.BufferedIOBase,
    path: Path,
    data: bytes | None,
    header: Header,
    names: list[str],
    every: int,
) -> list[np.ndarray]:
    if header.order:
        return _binary_columns(path, data, header, names, every)
    return _text_columns(file, header, names, every)


def coordinates(vertex: Element) -> list[str]:
    """The names of the coordinates of vertices.

    Raises:
        ValueError: if they have no x and y, or lists in their place.
    """
    found = {p.name: p for p in vertex.properties}
    names = ["x", "y", "z"] if "z" in found else ["x", "y"]
    missing = [name for name in names if name not in found or found[name].length]
    if missing:
        raise ValueError(f"its vertices have no number {missing[0]}")
    return names


def _binary_columns(
    path: Path, data: bytes | None, header: Header, names: list[str], every: int
) -> list[np.ndarray]:
    """Of every so many vertices; all other elements are walked over for the check."""
    content = (
        np.memmap(path, np.uint8, "r")
        if data is None
        else np.frombuffer(data, np.uint8)
    )
    before, vertex = header.before_and_vertex()
    if vertex.has_lists:
        raise ValueError("vertices with lists")
    at, start = header.start, 0
    for element in header.elements:
        if element is vertex:
            start = at
        at = end_of(content, element, header.order, at)
    rest = len(content) - at
    if rest and bytes(content[at : at + 100]).strip():
        raise ValueError(f"{rest} bytes more than the header promises")
    rows = np.frombuffer(content, vertex.dtype(header.order), vertex.num, start)
    return [np.array(rows[name][::every]) for name in names]


def _text_columns(
    file: io.BufferedIOBase, header: Header, names: list[str], every: int
) -> list[np.ndarray]:
    before, vertex = header.before_and_vertex()
    lines = (line for line in byte_lines(file) if line.strip())
    skipped = sum(e.num for e in before)
    for _ in itertools.islice(lines, skipped):
        pass
    order = [p.name for p in vertex.properties]
    width = None if vertex.has_lists else len(order)
    if vertex.has_lists and any(p.length for p in vertex.properties[: len(names)]):
        raise ValueError("vertices with lists")
    mine = _of_width(itertools.islice(lines, vertex.num), width)
    rows = number_rows(
        itertools.islice(mine, 0, None, every), [order.index(a) for a in names]
    )
    for _ in mine:  # those behind the last one that is kept
        pass
    rest = sum(1 for _ in lines)
    wanted = sum(e.num for e in header.elements) - skipped - vertex.num
    if len(rows) != -(-vertex.num // every) or rest != wanted:
        raise ValueError(f"not the {vertex.num} vertices and {wanted} other rows")
    return list(rows.T)


def _of_width(lines: Iterator[bytes], width: int | None) -> Iterator[bytes]:
    for line in lines:
        if width is not None and len(line.split()) != width:
            raise ValueError(f"a vertex of {len(line.split())} numbers, not {width}")
        yield line
