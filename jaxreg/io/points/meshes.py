"""The vertices of meshes: Wavefront OBJ and STL, text or binary.

By hand: trimesh takes ten times what is kept and passes over damaged lines.
"""

import io
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import reading
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, byte_lines, number_rows, records


_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("tag", "<u2")])
_LONGEST = 1_000_000  # of a line that goes on
_Scan = tuple[np.ndarray, tuple[str, ...], int]


def parse_obj(data: bytes | None, path: Path, step: Step) -> _Scan:
    """The vertices of an OBJ file; of one with faces, those that a face uses.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of vertices which of them to keep.

    Returns:
        `(n, 3)` distinct vertices in the order of the file, float32 if that loses
        nothing, else float64; no names of columns; of how many vertices one was kept.

    Raises:
        InputError: if the data are no OBJ file, hold no vertices, or a vertex has no
            three numbers or a face no such vertex, which the message names by its line.
    """
    with reading(path, "OBJ"), _open(data, path) as file:
        points, faces = _obj(file, path)
        if len(faces):
            used = np.zeros(len(points), bool)
            used[faces] = True
            points = points[used]
    return _distinct(points, path, step)


def parse_stl(data: bytes | None, path: Path, step: Step) -> _Scan:
    """The corners of the triangles of an STL file, each once; else as `parse_obj`.

    Of a binary one that is to be thinned, the first corners of every so many triangles
    are kept.
    """
    size = path.stat().st_size if data is None else len(data)
    with reading(path, "STL"), _open(data, path) as file:
        head = file.read(84)
        num = int.from_bytes(head[80:], "little")
        if len(head) == 84 and size == 84 + num * _TRIANGLE.itemsize:
            every = step(num)
            corners = records(file, num, _TRIANGLE, every)["corners"]
            points = (corners if every == 1 else corners[:, :1]).reshape(-1, 3)
            return *_distinct(points, path, lambda _: 1)[:2], every
        if not head.lstrip().startswith(b"solid"):
            raise ValueError(
                f"{num} triangles promised, {size} bytes found"
                if len(head) == 84
                else "shorter than its header"
            )
        file.seek(0)
        points = number_rows(_corners(file), [1, 2, 3])
    return _distinct(points, path, step)


def _open(data: bytes | None, path: Path) -> io.BufferedIOBase:
    return path.open("rb") if data is None else io.BytesIO(data)


def _distinct(points: np.ndarray, path: Path, step: Step) -> _Scan:
    """STL repeats a vertex for every triangle, OBJ for every seam."""
    if len(points) == 0:
        raise InputError(f"{path}: holds no points.\nExport or copy the scan again.")
    _, first = np.unique(points, axis=0, return_index=True)
    every = step(len(first))
    points = points[np.sort(first)[::every]]
    with np.errstate(over="ignore", invalid="ignore"):
        narrow = points.astype(np.float32)
    exact = np.array_equal(narrow, points, equal_nan=True)
    return as_points(narrow if exact else points, str(path)), (), every


def _obj(file: io.BufferedIOBase, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """All vertices, `(n, 3)`, and the numbers of those that a face names."""
    vertices, faces = array("d"), array("q")
    for number, line in _joined(byte_lines(file)):
        word, *values = line.split(b"#")[0].split() or [b""]
        try:
            if word == b"v":
                if not 3 <= len(values) <= 8:
                    raise ValueError(f"a vertex of {len(values)} numbers")
                vertices.extend([float(x) for x in values[:3]])
            elif word == b"f":
                named = [int(x.split(b"/", 1)[0]) for x in values]
                _require_face(named, len(vertices) // 3)
                num = len(vertices) // 3
                faces.extend([k - 1 if k > 0 else num + k for k in named])
            elif b"\0" in line:
                raise ValueError("NUL bytes")
        except ValueError as err:
            raise InputError(
                f"{path}, line {number}: {err}; the file is damaged or no OBJ file.\n"
                "Export the scan again, or as PLY."
            ) from err
    points = np.frombuffer(vertices).reshape(-1, 3)
    used = np.frombuffer(faces, dtype=np.int64)
    if used.size and used.max() >= len(points):
        raise ValueError(
            f"a face names vertex {used.max() + 1}, there are {len(points)}"
        )
    return points, used


def _joined(lines: Iterator[bytes]) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers; one that ends in a backslash goes on in the next."""
    before = b""
    for number, line in enumerate(lines, start=1):
        if line.rstrip().endswith(b"\\") and len(before) < _LONGEST:
            before += line.rstrip()[:-1] + b" "
        else:
            yield number, before + line
            before = b""
    if before:
        raise ValueError("it ends in a backslash")


def _require_face(named: list[int], num: int) -> None:
    if len(named) < 3 or 0 in named or min(named) < -num:
        raise ValueError(f"a face of the vertices {named}")


def _corners(file: io.BufferedIOBase) -> Iterator[bytes]:
    """The lines of vertices of an ASCII file, checked to be three a triangle."""
    inside, corners, ended = False, 0, False
    for line in byte_lines(file):
        word = line.split(None, 1)[:1]
        if word == [b"vertex"]:
            if len(line.split()) != 4 or not inside:
                raise ValueError(f"the line {line[:40]!r}")
            corners += 1
            yield line
        elif word == [b"facet"]:
            inside, ended = True, False
        elif word == [b"endfacet"]:
            if corners != 3 or not inside:
                raise ValueError(f"a triangle of {corners} corners")
            inside, corners = False, 0
        elif word == [b"endsolid"]:
            ended = True
        elif word not in ([], [b"solid"], [b"outer"], [b"endloop"], [b"color"]):
            raise ValueError(f"the line {line[:40]!r}")
    if inside or not ended:
        raise ValueError("no line endsolid at its end")
