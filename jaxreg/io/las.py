"""LAS and LAZ files of airborne and terrestrial laser scans, through laspy."""

import io
from pathlib import Path

import numpy as np

from jaxreg.io.arrays import as_points
from jaxreg.io.extras import reader, unreadable


def parse_las(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The points of a LAS or LAZ file; `path` is for messages only.

    Returns:
        `(n, 3)` float64 (map coordinates do not fit into float32), scale and offset
        applied; the names of the dimensions.

    Raises:
        InputError: if the data are no whole LAS or LAZ file or hold no points.
        MissingExtraError: if laspy or lazrs is not installed.
    """
    laspy = reader("laspy", "LAS and LAZ")
    reader("lazrs", "LAZ")
    try:
        las = laspy.read(io.BytesIO(data))
        points = np.asarray(las.xyz, dtype=np.float64)
        fields = tuple(las.point_format.dimension_names)
        promised = las.header.point_count
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, "LAS or LAZ", err) from err
    if len(points) != promised:
        raise unreadable(path, "LAS or LAZ", f"{len(points)} points of {promised}")
    return as_points(points, str(path)), fields
