"""LAS and LAZ files of airborne and terrestrial laser scans, through laspy."""

import io
import struct
from pathlib import Path

import numpy as np

from jaxreg.io.extras import require
from jaxreg.io.files import reading
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, every_row


# Points that are unpacked at a time, some 34 bytes each.
_CHUNK = 1_000_000
# Bytes of a header of version 1.0 to 1.2, of a record of variable length before and
# behind the points; a point takes at least twenty, packed a fiftieth of a byte.
_SHORTEST, _VLR, _EVLR, _POINT, _MOST_RATIO = 227, 54, 60, 20, 1000


def parse_las(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The points of a LAS or LAZ file, which is unpacked by chunks.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of points which of them to keep.

    Returns:
        `(n, 3)` float64 (map coordinates do not fit into float32), scale and offset
        applied; the names of the dimensions; of how many points one was kept.

    Raises:
        InputError: if the data are no whole LAS or LAZ file or hold no points.
        MissingExtraError: if laspy or lazrs is not installed.
    """
    laspy = require("laspy", "Reading LAS and LAZ")
    require("lazrs", "Reading LAZ")
    size = path.stat().st_size if data is None else len(data)
    with reading(path, "LAS or LAZ"):
        with path.open("rb") if data is None else io.BytesIO(data) as file:
            _check_header(file, size)
        with laspy.open(path if data is None else io.BytesIO(data)) as file:
            fields = tuple(file.header.point_format.dimension_names)
            promised, found, parts = file.header.point_count, 0, []
            every = step(max(promised, 1))
            for chunk in file.chunk_iterator(min(_CHUNK, max(promised, 1))):
                first = -found % every
                columns = [getattr(chunk, axis)[first::every] for axis in "xyz"]
                parts.append(np.stack(columns, axis=1).astype(np.float64))
                found += len(chunk)
        if found != promised:
            raise ValueError(f"{found} points of {promised}")
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
        if not np.isfinite(points).all():
            raise ValueError("scales or offsets are not finite")
    return as_points(points, str(path)), fields, every


def read_columns(
    data: bytes | None, path: Path, names: list[str], every: int
) -> list[np.ndarray]:
    """Dimensions of one of so many points, in their types."""
    laspy = require("laspy", "Reading LAS and LAZ")
    found, parts = 0, []
    with laspy.open(path if data is None else io.BytesIO(data)) as file:
        for chunk in file.chunk_iterator(_CHUNK):
            first = -found % every
            parts.append([np.array(chunk[name])[first::every] for name in names])
            found += len(chunk)
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _check_header(file: io.BufferedIOBase, size: int) -> None:
    """Compares the counts of the header with the size of the file.

    Raises:
        ValueError: that names the count.
    """
    head = file.read(375)
    if len(head) < _SHORTEST or head[:4] != b"LASF":
        raise ValueError("no header")
    length, start, num_records, kind, point = struct.unpack_from("<HIIBH", head, 94)
    (num_points,) = struct.unpack_from("<I", head, 107)
    if not _SHORTEST <= length <= start <= size:
        raise ValueError(f"points are to begin at byte {start} of {size}")
    if num_records * _VLR > start - length:
        raise ValueError(f"{num_records} records of variable length do not fit in")
    if head[25] >= 4 and len(head) == 375:
        first, number = struct.unpack_from("<QI", head, 235)
        (wide,) = struct.unpack_from("<Q", head, 247)
        if num_points not in (0, wide):
            raise ValueError(f"its two counts of points are {num_points} and {wide}")
        num_points = wide
        if number and not (start <= first and first + number * _EVLR <= size):
            raise ValueError(f"{number} extended records of variable length do not fit")
        room = (first if number else size) - start
    else:
        room = size - start
    packed = bool(kind & 0x80)
    if point < _POINT or num_points * point > room * (_MOST_RATIO if packed else 1):
        raise ValueError(f"{num_points} points of {point} bytes in {room} bytes")
    if packed and num_points:
        _check_chunks(file, start, size, num_points)
    # A few bytes behind the points are usual, a whole point is not.
    if not packed and room - num_points * point >= point:
        raise ValueError(f"{num_points} points promised, more are there")


def _check_chunks(file: io.BufferedIOBase, start: int, size: int, num: int) -> None:
    """Compares the table of chunks of a LAZ file with its size.

    Raises:
        ValueError: if it cannot lie in the file.
    """
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written to a stream: the place stands at the end
        file.seek(size - 8)
        (table,) = struct.unpack("<q", file.read(8))
    if not start + 8 <= table <= size - 8:
        raise ValueError(f"its table of chunks is to begin at byte {table} of {size}")
    file.seek(table)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks > num:
        raise ValueError(f"{chunks} chunks of {num} points")
