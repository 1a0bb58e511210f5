"""PCD files of the Point Cloud Library: ASCII, binary, compressed; through pypcd4."""

import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.extras import require, unreadable
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, every_row, number_rows, records


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
    try:
        with path.open("rb") if data is None else io.BytesIO(data) as file:
            header = pypcd4.MetaData.parse_header(_header(file))
            fields = tuple(header.fields)
            names = ["x", "y", "z"] if "z" in fields else ["x", "y"]
            every = step(max(header.points, 1))
            columns = _columns(pypcd4, file, header, names, every)
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, "PCD", err) from err
    if len(columns[0]) != -(-header.points // every):
        raise unreadable(path, "PCD", f"not the {header.points} points it promises")
    return as_points(np.stack(columns, axis=1), str(path)), fields, every


def _header(file: Any) -> list[str]:
    """Its lines; the data begin after them."""
    lines: list[str] = []
    for line in itertools.islice(file, 100):
        lines.append(line.decode("utf-8").strip())
        if lines[-1].startswith("DATA"):
            return lines
    raise ValueError("no line DATA")


def _columns(
    pypcd4: Any, file: Any, header: Any, names: list[str], every: int
) -> list[np.ndarray]:
    dtype = header.build_dtype()
    if header.data == pypcd4.Encoding.BINARY:
        rows = records(file, header.points, dtype, every)
    elif header.data == pypcd4.Encoding.ASCII:
        filled = (line for line in file if line.strip())
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
