"""LAS and LAZ files of airborne and terrestrial laser scans, through laspy."""

import io
from pathlib import Path

import numpy as np

from jaxreg.io.extras import require, unreadable
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, every_row


# Points that are unpacked at a time, some 34 bytes each.
_CHUNK = 1_000_000


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
    try:
        with laspy.open(path if data is None else io.BytesIO(data)) as file:
            fields = tuple(file.header.point_format.dimension_names)
            promised, found, parts = file.header.point_count, 0, []
            every = step(max(promised, 1))
            for chunk in file.chunk_iterator(_CHUNK):
                first = -found % every
                columns = [getattr(chunk, axis)[first::every] for axis in "xyz"]
                parts.append(np.stack(columns, axis=1).astype(np.float64))
                found += len(chunk)
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, "LAS or LAZ", err) from err
    if found != promised:
        raise unreadable(path, "LAS or LAZ", f"{found} points of {promised}")
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    return as_points(points, str(path)), fields, every
