"""PCD files of the Point Cloud Library: ASCII, binary, compressed; through pypcd4."""

import io
import itertools
import struct
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.extras import require
from jaxreg.io.files import reading
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, byte_lines, every_row, number_rows, records


_LONGEST_LINE = 100_000


def parse_pcd(
    data: bytes | None, path: Path, step: Step = every_row
) -> tuple[np.ndarray, tuple[str, ...], int]:
    """The points of a PCD file.

    The viewpoint of the header is not applied: points stay as they are stored. Of ASCII
    and binary files only the rows that are kept stay in memory; compressed ones are
    unpacked whole.

    Args:
        data: its content; None reads the file.
        path: of the file, and for messages.
        step: tells from the number of points which of them to keep.

    Returns:
        `(n, d)` float32 unless the file stores wider coordinates, 2D if it has no field
        z, rows of NaN for missing points included; the names of the fields; of how many
        points one was kept.

    Raises:
        InputError: if the data are no whole PCD file or hold no points.
        MissingExtraError: if pypcd4 is not installed.
    """
    pypcd4 = require("pypcd4", "Reading PCD")
    size = path.stat().st_size if data is None else len(data)
    with reading(path, "PCD"):
        with path.open("rb") if data is None else io.BytesIO(data) as file:
            header = pypcd4.MetaData.parse_header(header_lines(file))
            _check_header(pypcd4, header, file, size)
            fields = tuple(header.fields)
            names = ["x", "y", "z"] if "z" in fields else ["x", "y"]
            every = step(max(header.points, 1))
            columns = _columns(pypcd4, file, header, names, every)
        if len(columns[0]) != -(-header.points // every):
            raise ValueError(f"not the {header.points} points it promises")
    return as_points(np.stack(columns, axis=1), str(path)), fields, every


def read_columns(
    data: bytes | None, path: Path, names: list[str], every: int
) -> list[np.ndarray]:
    """Fields of one of so many points, in their types."""
    pypcd4 = require("pypcd4", "Reading PCD")
    with path.open("rb") if data is None else io.BytesIO(data) as file:
        header = pypcd4.MetaData.parse_header(header_lines(file))
        return _columns(pypcd4, file, header, names, every)


def header_lines(file: Any) -> list[str]:
    """Its lines; the data begin after them."""
    lines: list[str] = []
    for _ in range(100):
        lines.append(file.readline(_LONGEST_LINE).decode("utf-8").strip())
        if lines[-1].startswith("DATA"):
            return lines
    raise ValueError("no line DATA")


def _check_header(pypcd4: Any, header: Any, file: Any, size: int) -> None:
    """Compares the counts of the header with the rest of the file.

    Raises:
        ValueError: that names the count.
    """
    if len(set(header.fields)) != len(header.fields):
        raise ValueError(f"two fields have one name: {' '.join(header.fields)}")
    if header.width * header.height != header.points or header.points < 0:
        raise ValueError(
            f"width {header.width} times height {header.height} is not the number of "
            f"points {header.points}"
        )
    if min([*header.size, *header.count, 1]) < 1:
        raise ValueError("sizes and counts of fields must be positive")
    if not header.points:
        raise ValueError("it says that it has no points")
    rest = size - file.tell()
    num_numbers = header.points * sum(header.count)
    num_bytes = header.points * sum(
        a * b for a, b in zip(header.size, header.count, strict=True)
    )
    if header.data == pypcd4.Encoding.ASCII:
        fits = 2 * num_numbers <= rest + 1
    elif header.data == pypcd4.Encoding.BINARY:
        point = num_bytes // header.points  # a whole one more is one too many
        fits = num_bytes <= rest < num_bytes + max(point, 16)
    else:
        at = file.tell()
        packed, unpacked = struct.unpack("<II", file.read(8))
        file.seek(at)
        # Its coder spends three bytes at least on 264.
        fits = packed <= rest - 8 and unpacked == num_bytes <= 90 * packed
    if not fits:
        raise ValueError(f"{header.points} points do not fit {rest} bytes of data")


def _columns(
    pypcd4: Any, file: Any, header: Any, names: list[str], every: int
) -> list[np.ndarray]:
    dtype = header.build_dtype()
    if header.data == pypcd4.Encoding.BINARY:
        rows = records(file, header.points, dtype, every)
    elif header.data == pypcd4.Encoding.ASCII:
        filled = (line for line in byte_lines(file) if line.strip())
        lines = itertools.islice(filled, 0, None, every)
        places = [list(dtype.names).index(name) for name in names]
        return [
            column.astype(dtype[name])
            for column, name in zip(number_rows(lines, places).T, names, strict=True)
        ]
    else:
        file.seek(0)
        rows = pypcd4.PointCloud.from_fileobj(file).pc_data[::every]
    return [np.asarray(rows[name]) for name in names]
