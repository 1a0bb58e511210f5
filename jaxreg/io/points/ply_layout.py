"""Where the elements of a PLY file lie: its header, checked against its size.

By hand: plyfile makes an object of every face and believes the counts of the header.
"""

import io
import struct
from typing import NamedTuple

import numpy as np


_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
} | {
    f"{name}{8 * size}": f"{kind}{size}"
    for name, kind, sizes in (
        ("int", "i", (1, 2, 4)),
        ("uint", "u", (1, 2, 4)),
        ("float", "f", (4, 8)),
    )
    for size in sizes
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_LINE = 10_000
_MOST_LINES = 10_000


class Property(NamedTuple):
    """Of an element; `length` is the type of a list's length, None without a list."""

    name: str
    type: str
    length: str | None


class Element(NamedTuple):
    """A kind of row."""

    name: str
    num: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether the rows differ in length."""
        return any(p.length for p in self.properties)

    def dtype(self, order: str) -> np.dtype:
        """Of a binary row with lists of no items."""
        return np.dtype(
            [(p.name, order + (p.length or p.type)) for p in self.properties]
        )


class Header(NamedTuple):
    """Byte order ("" for ASCII), elements, and where the data begin."""

    order: str
    elements: tuple[Element, ...]
    start: int

    def before_and_vertex(self) -> tuple[tuple[Element, ...], Element]:
        """The elements before the vertices, and these."""
        names = [e.name for e in self.elements]
        if names.count("vertex") != 1:
            raise ValueError(f"{names.count('vertex')} elements called vertex")
        k = names.index("vertex")
        return self.elements[:k], self.elements[k]


def read_header(file: io.BufferedIOBase, size: int) -> Header:
    """Reads the header of a file of so many bytes.

    Raises:
        ValueError: if it makes no sense, or promises more than the file can hold.
    """
    order, elements = None, []
    for words in _header_lines(file):
        match words:
            case ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit():
                elements.append((name, int(count), []))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append(Property(name, _TYPES[kind], None))
            case ["property", "list", length, kind, name] if elements:
                elements[-1][2].append(Property(name, _TYPES[kind], _TYPES[length]))
            case _:
                raise ValueError(f"header line {' '.join(words)[:60]!r}")
    if order is None:
        raise ValueError("no line that names the format")
    found = tuple(Element(name, num, tuple(rows)) for name, num, rows in elements)
    for element in found:
        names = [p.name for p in element.properties]
        if len(set(names)) != len(names):
            raise ValueError(f"two properties of {element.name} have one name")
    header = Header(order, found, file.tell())
    rows = [
        e.num * (e.dtype(order).itemsize if order else 2 * len(e.properties))
        for e in found
    ]
    if sum(rows) > size - header.start + (not order):  # no line end behind the last
        raise ValueError(
            f"{', '.join(f'{e.num} x {e.name}' for e in found)} promised, "
            f"{size - header.start} bytes follow"
        )
    return header


def _header_lines(file: io.BufferedIOBase):
    for number in range(_MOST_LINES):
        line = file.readline(_LONGEST_LINE)
        words = line.decode("utf-8", "replace").split()
        if (words == ["ply"]) != (number == 0):
            raise ValueError("no header of a PLY file")
        if words == ["end_header"]:
            return
        if not line:
            break
        if words:
            yield words
    raise ValueError("no line end_header")


def end_of(data: np.ndarray, element: Element, order: str, start: int) -> int:
    """The byte behind a binary element that begins at a byte of the data.

    Raises:
        ValueError: if the data end before.
    """
    row = element.dtype(order)
    end = start + element.num * row.itemsize
    if not element.has_lists:
        if end > len(data):
            raise ValueError(f"it ends within {element.name}")
        return end
    return _end_of_lists(data.data, element, order, start)


def _end_of_lists(data: memoryview, element: Element, order: str, at: int) -> int:
    parts, skipped = [], 0
    for p in element.properties:
        width = np.dtype(p.type).itemsize
        if p.length is None:
            skipped += width
        else:
            kind = np.dtype(order + p.length)
            parts.append((skipped, struct.Struct(order + kind.char), width))
            skipped = 0
    try:
        for _ in range(element.num):
            for before, length, width in parts:
                (num,) = length.unpack_from(data, at + before)
                if num < 0 or num != int(num):
                    raise ValueError(f"a list of {num} items in {element.name}")
                at += before + length.size + int(num) * width
            at += skipped
    except struct.error as err:
        raise ValueError(f"it ends within {element.name}") from err
    if at > len(data):
        raise ValueError(f"it ends within {element.name}")
    return at
