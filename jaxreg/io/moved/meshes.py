"""OBJ and STL: vertices and normals, the rest to the letter."""

from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from jaxreg.io.moved import lines, records
from jaxreg.io.moved.motion import Moving


_FACET = np.dtype(
    [(name, "<f4") for name in ("nx", "ny", "nz")]
    + [(f"{axis}{k}", "<f4") for k in range(3) for axis in "xyz"]
    + [("attribute", "<u2")]
)


def move_obj(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes lines again; those of vertices (`v`) and normals (`vn`) are moved."""
    _move_lines(path, out, moving, {"v": 1}, {"vn": 1})


def move_stl(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes triangles again, binary or text; coordinates stay float32."""
    with path.open("rb") as file:
        head = file.read(84)
        num = int.from_bytes(head[80:84], "little")
        if path.stat().st_size != 84 + 50 * num:
            _move_lines(path, out, moving, {"vertex": 1}, {"facet": 2})
            return
        out.write(head)
        for rows in records.blocks(file, num, _FACET):
            new = rows
            for k in range(3):
                corner, normal = [f"{axis}{k}" for axis in "xyz"], ("nx", "ny", "nz")
                turned = normal if k == 0 else None
                new = records.move_rows(new, _FACET, moving, corner, turned)
            out.write(new.tobytes())


def _move_lines(
    path: Path,
    out: BufferedIOBase,
    moving: Moving,
    points: dict[str, int],
    normals: dict[str, int],
) -> None:
    """Lines whose first word is one of these, with numbers from that word on."""
    with path.open("rb") as file:
        for words, start, line in _words(file, points | normals):
            if start:
                change = moving.points if words[0] in points else moving.directions
                old = np.array([words[start : start + 3]], np.float64)
                new = (lines.WIDE % x for x in change(old)[0])
                words[start : start + 3] = new
                indent = line[: len(line) - len(line.lstrip())]
                line = indent + " ".join(words).encode("latin1") + b"\n"
            out.write(line)


def _words(
    file: BufferedIOBase, starts: dict[str, int]
) -> Iterator[tuple[list[str], int, bytes]]:
    for line in file:
        words = line.decode("latin1").split()
        yield words, starts.get(words[0], 0) if words else 0, line
