"""The vertices of meshes, OBJ and STL, through trimesh; of large ones without it."""

import io
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxreg.io.extras import require, unreadable
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, every_row, number_rows, records


# Bytes of a file from which on no mesh is built: trimesh has no other way to read and
# takes 10 GB for 20 million vertices, lines and records by blocks half of one.
_LARGE = 100_000_000
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("tag", "<u2")])
_Scan = tuple[np.ndarray, tuple[str, ...], int]


def parse_obj(data: bytes | None, path: Path, step: Step = every_row) -> _Scan:
    """The vertices of an OBJ file; of one with faces, those that a face uses.

    A large one that is not compressed is thinned line by line, with vertices that no
    face uses.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of vertices which of them to keep.

    Returns:
        `(n, 3)` distinct vertices in the order of the file (within a material), float32
        if that loses nothing, else float64; no names of columns; of how many
        vertices one was kept.

    Raises:
        InputError: if the data are no OBJ file or hold no vertices.
        MissingExtraError: if trimesh is not installed.
    """
    return _vertices(data, path, "obj", b"v", step)


def parse_stl(data: bytes | None, path: Path, step: Step = every_row) -> _Scan:
    """The corners of the triangles of an STL file, each once; else as `parse_obj`.

    Of a large binary one the first corners of every so many triangles are kept.
    """
    return _vertices(data, path, "stl", b"vertex", step)


def _vertices(
    data: bytes | None, path: Path, kind: str, word: bytes, step: Step
) -> _Scan:
    trimesh = require("trimesh", "Reading OBJ and STL")
    try:
        if data is None and step is not every_row and path.stat().st_size > _LARGE:
            points, every = _some_vertices(path, word, step)
        else:
            every, content = 1, path.read_bytes() if data is None else data
            scene = trimesh.load_scene(
                io.BytesIO(content), file_type=kind, process=False, maintain_order=True
            )
            parts = [np.asarray(g.vertices, float) for g in scene.geometry.values()]
            points = np.concatenate(parts)
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, kind.upper(), err) from err
    # STL repeats a vertex for every triangle, OBJ for every material.
    _, first = np.unique(points, axis=0, return_index=True)
    points = points[np.sort(first)]
    narrow = points.astype(np.float32)
    exact = np.array_equal(narrow, points, equal_nan=True)
    return as_points(narrow if exact else points, str(path)), (), every


def _some_vertices(path: Path, word: bytes, step: Step) -> tuple[np.ndarray, int]:
    """One corner of some triangles of a binary STL file, else what some lines hold."""
    with path.open("rb") as file:
        num = int.from_bytes(file.read(84)[80:], "little")
        if path.stat().st_size == 84 + num * _TRIANGLE.itemsize:
            rows = records(file, num, _TRIANGLE, step(num))
            return rows["corners"][:, 0], step(num)
    every = step(sum(1 for _ in _lines(path, word)))
    lines = itertools.islice(_lines(path, word), 0, None, every)
    return number_rows(lines, [1, 2, 3]), every


def _lines(path: Path, word: bytes) -> Iterator[bytes]:
    """Those that begin with the word."""
    with path.open("rb") as file:
        yield from (line for line in file if line.split(None, 1)[:1] == [word])
