"""E57 files of terrestrial scanners (ASTM E2807), of one or more scans: pye57."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.extras import require
from jaxreg.io.files import reading
from jaxreg.io.points.arrays import as_points
from jaxreg.io.points.thinning import Step, every_row


_CHUNK = 1_000_000  # points that are unpacked at a time


def read_e57(
    path: Path, step: Step = every_row
) -> dict[str, tuple[np.ndarray, tuple[str, ...], int]]:
    """The scans of an E57 file by name; unnamed ones are `scan0`, `scan1`, ...

    The pose that the file gives to a scan is applied, so that all are in the frame of
    the file. Points that the scanner marked as invalid are left out.

    Args:
        path: the file.
        step: tells from the number of points of a scan which of them to keep.

    Returns:
        For each scan `(n, 3)` float64, in metres by the standard, the names of its
        fields, and of how many points one was kept.

    Raises:
        InputError: if it is no whole E57 file, or a scan of it holds no points.
        MissingExtraError: if pye57 is not installed.
    """
    pye57 = require("pye57", "Reading E57")
    scans = {}
    with reading(path, "E57"):
        size = path.stat().st_size
        with pye57.E57(str(path)) as file:
            for k, name in enumerate(scan_names(file)):
                header = file.get_header(k)
                if header.point_count > 8 * size:  # not a bit each
                    raise ValueError(f"{header.point_count} points in {size} bytes")
                every = step(max(header.point_count, 1))
                points = _some_points(pye57, file, header, every)
                scans[name] = points, tuple(header.point_fields), every
        if not scans:
            raise ValueError("no scans")
    return {
        name: (as_points(points, f"{path}:{name}"), fields, every)
        for name, (points, fields, every) in scans.items()
    }


def scan_names(file: Any) -> list[str]:
    """Of the scans of an open file, as `read_e57` calls them."""
    names: list[str] = []
    for k in range(file.scan_count):
        name = _name(file.get_header(k), k)
        names.append(f"{name}-{k}" if name in names else name)
    return names


def read_columns(
    path: Path, key: str | None, names: list[str], every: int
) -> list[np.ndarray]:
    """Fields of one of so many points of a scan, the first one without a name."""
    pye57 = require("pye57", "Reading E57")
    parts, found = [], 0
    with pye57.E57(str(path)) as file:
        known = scan_names(file)
        header = file.get_header(known.index(key) if key in known else 0)
        flags = [f for f in header.point_fields if f.endswith("InvalidState")]
        data, buffers = file.make_buffers([*names, *flags[:1]], _CHUNK)
        chunks = header.points.reader(buffers)
        while count := chunks.read():
            rows = slice(-found % every, count, every)
            found += count
            valid = data[flags[0]][rows] == 0 if flags else slice(None)
            parts.append([data[name][rows][valid].copy() for name in names])
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _some_points(pye57: Any, file: Any, header: Any, every: int) -> np.ndarray:
    """As `pye57.E57.read_scan` has them, but unpacked by chunks."""
    system = header.get_coordinate_system(pye57.e57.COORDINATE_SYSTEMS)
    flag = f"{system.name.lower()}InvalidState"
    flags = [flag] if flag in header.point_fields else []
    chunk = min(_CHUNK, max(header.point_count, 1))
    data, buffers = file.make_buffers([*system.value, *flags], chunk)
    chunks, found = header.points.reader(buffers), 0
    parts = [np.zeros((0, 3))]
    while count := chunks.read():
        rows = slice(-found % every, count, every)
        found += count
        points = np.stack([data[name][rows] for name in system.value], axis=1)
        if flags:
            points = points[data[flag][rows] == 0]
        if system is pye57.e57.COORDINATE_SYSTEMS.SPHERICAL:
            points = pye57.utils.convert_spherical_to_cartesian(points)
        if header.has_pose():
            points = file.to_global(points, header.rotation, header.translation)
        parts.append(points)
    if found != header.point_count:
        raise EOFError(f"{found} points of {header.point_count}")
    return np.concatenate(parts)


def _name(header: object, number: int) -> str:
    node = header.node  # pyright: ignore[reportAttributeAccessIssue]
    name = node["name"].value() if node.isDefined("name") else ""
    return name.replace("/", "_").replace("\\", "_") or f"scan{number}"
