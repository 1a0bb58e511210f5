"""PCD files of the Point Cloud Library: ASCII, binary, compressed; through pypcd4."""

import io
from pathlib import Path

import numpy as np

from jaxreg.io.arrays import as_points
from jaxreg.io.extras import reader, unreadable


def parse_pcd(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The points of a PCD file; `path` is for messages only.

    The viewpoint of the header is not applied: points stay as they are stored.

    Returns:
        `(n, d)` float32 unless the file stores wider coordinates, 2D if it has no field
        z, rows of NaN for missing points included; the names of the fields.

    Raises:
        InputError: if the data are no whole PCD file or hold no points.
        MissingExtraError: if pypcd4 is not installed.
    """
    pypcd4 = reader("pypcd4", "PCD")
    try:
        cloud = pypcd4.PointCloud.from_fileobj(io.BytesIO(data))
        fields = tuple(cloud.fields)
        names = ("x", "y", "z") if "z" in fields else ("x", "y")
        columns = [np.asarray(cloud.pc_data[name]) for name in names]
        promised = cloud.metadata.points
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, "PCD", err) from err
    if len(columns[0]) != promised:
        found = f"{len(columns[0])} points of {promised}"
        raise unreadable(path, "PCD", found)
    return as_points(np.stack(columns, axis=1), str(path)), fields
