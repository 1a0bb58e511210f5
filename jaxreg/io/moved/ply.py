"""PLY: the header but for types, the other elements to the byte, and their order.

By hand: plyfile makes an object of every face, and holds the whole file.
"""

import itertools
import re
import shutil
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from jaxreg.io.moved import lines, records
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.columns import NORMALS, named
from jaxreg.io.points.ply import coordinates
from jaxreg.io.points.ply_layout import Element, Header, end_of, read_header


def move_ply(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes the file again; coordinates become double where float has few digits."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = read_header(file, size)
        _, vertex = header.before_and_vertex()
        names = coordinates(vertex)[: moving.dim]
        normals = named([p.name for p in vertex.properties], NORMALS)
        wide = _is_wide(vertex, names) or moving.goes_far(_points(path, header, names))
        file.seek(0)
        out.write(_retyped(file.read(header.start), names, wide))
        if header.order:
            start = _start(path, header)
            _copy(file, out, start - header.start)
            old = vertex.dtype(header.order)
            new = records.widened(old, names) if wide else old
            for rows in records.blocks(file, vertex.num, old):
                out.write(
                    records.move_rows(rows, new, moving, names, normals).tobytes()
                )
        else:
            _move_text(file, out, header, moving, (names, normals), wide)
        shutil.copyfileobj(file, out)


def _is_wide(vertex: Element, names: list[str]) -> bool:
    """Whether a coordinate is stored with more digits than float32, or as integer."""
    kinds = {p.name: np.dtype(p.type) for p in vertex.properties}
    return any(kinds[a].kind != "f" or kinds[a].itemsize > 4 for a in names)


def _start(path: Path, header: Header) -> int:
    """The byte that binary vertices begin at."""
    before, vertex = header.before_and_vertex()
    if vertex.has_lists:
        raise ValueError("vertices with lists")
    content, at = np.memmap(path, np.uint8, "r"), header.start
    for element in before:
        at = end_of(content, element, header.order, at)
    return at


def _points(path: Path, header: Header, names: list[str]) -> Iterator[np.ndarray]:
    before, vertex = header.before_and_vertex()
    with path.open("rb") as file:
        if header.order:
            file.seek(_start(path, header))
            for rows in records.blocks(file, vertex.num, vertex.dtype(header.order)):
                yield records.columns(rows, names)
            return
        file.seek(header.start)
        places = [[p.name for p in vertex.properties].index(a) for a in names]
        filled = (line for line in file if line.strip())
        begin = sum(e.num for e in before)
        rows = itertools.islice(filled, begin, begin + vertex.num)
        while block := list(itertools.islice(rows, 100_000)):
            yield np.loadtxt(block, usecols=places, ndmin=2)


def _retyped(head: bytes, names: list[str], wide: bool) -> bytes:
    """The header with coordinates as double, in its own line ends."""
    if not wide:
        return head
    out, inside = [], False
    for line in head.splitlines(keepends=True):
        words = line.split()
        if words[:1] == [b"element"]:
            inside = words[1] == b"vertex"
        mine = inside and len(words) == 3 and words[2].decode("latin1") in names
        if mine and words[0] == b"property":
            line = re.sub(rb"(property\s+)\S+", rb"\1double", line, count=1)
        out.append(line)
    return b"".join(out)


def _move_text(
    file: BufferedIOBase,
    out: BufferedIOBase,
    header: Header,
    moving: Moving,
    names: tuple[list[str], tuple[str, ...] | None],
    wide: bool,
) -> None:
    before, vertex = header.before_and_vertex()
    order = [p.name for p in vertex.properties]
    places, normals = (
        None if group is None else [order.index(name) for name in group]
        for group in names
    )
    if vertex.has_lists:
        raise ValueError("vertices with lists")
    filled = (line for line in file if line.strip())
    out.writelines(itertools.islice(filled, sum(e.num for e in before)))
    rows = (
        line.decode("latin1").split() for line in itertools.islice(filled, vertex.num)
    )
    form = (lines.WIDE if wide else lines.NARROW).__mod__
    for row in lines.move_cells(rows, moving, places or [], normals, form):
        out.write((" ".join(row) + "\n").encode("latin1"))


def _copy(file: BufferedIOBase, out: BufferedIOBase, num: int) -> None:
    while num:
        data = file.read(min(num, 1 << 24))
        if not data:
            raise EOFError("cut off")
        out.write(data)
        num -= len(data)
