"""E57 files of terrestrial scanners (ASTM E2807), of one or more scans: pye57."""

from pathlib import Path

import numpy as np

from jaxreg.io.arrays import as_points
from jaxreg.io.extras import reader, unreadable


def read_e57(path: Path) -> dict[str, tuple[np.ndarray, tuple[str, ...]]]:
    """The scans of an E57 file by name; unnamed ones are `scan0`, `scan1`, ...

    The pose that the file gives to a scan is applied, so that all are in the frame of
    the file. Points that the scanner marked as invalid are left out.

    Returns:
        For each scan `(n, 3)` float64, in metres by the standard, and the names of its
        fields.

    Raises:
        InputError: if it is no whole E57 file, or a scan of it holds no points.
        MissingExtraError: if pye57 is not installed.
    """
    pye57 = reader("pye57", "E57")
    scans = {}
    try:
        with pye57.E57(str(path)) as file:
            for k in range(file.scan_count):
                scan = file.read_scan(k, ignore_missing_fields=True)
                columns = [scan[f"cartesian{axis}"] for axis in "XYZ"]
                header = file.get_header(k)
                name = _name(header, k)
                name = f"{name}-{k}" if name in scans else name
                scans[name] = np.stack(columns, axis=1), tuple(header.point_fields)
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, "E57", err) from err
    if not scans:
        raise unreadable(path, "E57", "no scans")
    return {
        name: (as_points(points, f"{path}:{name}"), fields)
        for name, (points, fields) in scans.items()
    }


def _name(header: object, number: int) -> str:
    node = header.node  # pyright: ignore[reportAttributeAccessIssue]
    name = node["name"].value() if node.isDefined("name") else ""
    return name.replace("/", "_").replace("\\", "_") or f"scan{number}"
