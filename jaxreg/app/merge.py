"""All placed scans in the common frame as one cloud, with what each looks like."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.app.colors import scan_colors
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.write_ply import write_ply


MAX_MERGED_POINTS = 2_000_000


class Merged(NamedTuple):
    """`(n, d)` points, and the scan and the row in it that each comes from."""

    points: np.ndarray
    owner: np.ndarray
    row: np.ndarray


class Look(NamedTuple):
    """How scans are shown in merged.ply.

    Attributes:
        colors: of each scan `(n_i, 3)` uint8 of its own, or None for one colour.
        normals: of each scan `(n_i, 3)`, or None.
        voxel: edge of the cubes of which one point each is kept; None for as many
            points as merged.ply has at most.
    """

    colors: Sequence[np.ndarray | None]
    normals: Sequence[np.ndarray | None]
    voxel: float | None = None


def merge_scans(
    scans: Sequence[np.ndarray],
    T_world_i: np.ndarray,
    placed: np.ndarray,
    max_points: int = MAX_MERGED_POINTS,
    voxel: float | None = None,
) -> Merged:
    """All placed scans in the common frame.

    Above `max_points` one point per cube is kept, the cubes being as small as that
    number allows within a factor of 1.25; with `voxel` they have that edge.

    Returns:
        Points, float32 if all scans are, else float64. Rows with NaN or inf are left
        out.
    """
    parts, owner, row = [], [], []
    for k, (scan, T) in enumerate(zip(scans, T_world_i, strict=True)):
        if placed[k]:
            finite = np.flatnonzero(np.isfinite(scan).all(axis=1))
            parts.append(scan[finite].astype(np.float64) @ T[:-1, :-1].T + T[:-1, -1])
            owner.append(np.full(len(finite), k))
            row.append(finite)
    merged = Merged(*(np.concatenate(x) for x in (parts, owner, row)))
    if voxel is not None:
        keep = _first_of_cubes(merged.points, voxel)
        merged = Merged(*(x[keep] for x in merged))
    elif len(merged.points) > max_points:
        keep = _thin(merged.points, max_points)
        merged = Merged(*(x[keep] for x in merged))
    narrow = all(s.dtype == np.float32 for s in scans)
    kind = np.float32 if narrow else np.float64
    return merged._replace(points=merged.points.astype(kind))


def write_merged(
    path: Path,
    scans: Sequence[np.ndarray],
    T_world_i: np.ndarray,
    member: np.ndarray,
    look: Look | None = None,
) -> None:
    """Writes the cloud of some scans as PLY.

    Each scan has a colour, or its own ones where `look` has them; normals are written
    if all these scans have them.

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plyfile is not installed.
    """
    voxel = None if look is None else look.voxel
    points, owner, row = merge_scans(scans, T_world_i, member, voxel=voxel)
    colors = np.round(255 * scan_colors(len(scans))[owner]).astype(np.uint8)
    ids = np.unique(owner)
    normals = None
    if look is not None and all(look.normals[k] is not None for k in ids):
        normals = np.zeros((len(points), 3), np.float32)
    for k in ids:
        if look is None:
            break
        mine = owner == k
        own, turned = look.colors[k], look.normals[k]
        if own is not None:
            colors[mine] = own[row[mine]]
        if normals is not None and turned is not None:
            normals[mine] = Moving(T_world_i[k]).directions(turned[row[mine]])
    write_ply(path, points, colors, normals=normals)


def _first_of_cubes(points: np.ndarray, size: float) -> np.ndarray:
    """The rows of the first point in each cube, in order."""
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    if np.prod(extent.astype(np.float64)) < 2**62:
        strides = np.cumprod([1, *extent[:-1]])
        _, first = np.unique(cell @ strides, return_index=True)
    else:
        _, first = np.unique(cell, axis=0, return_index=True)
    return np.sort(first)


def _thin(points: np.ndarray, max_points: int) -> np.ndarray:
    size = float(np.ptp(points, axis=0).max()) / 4096
    while True:
        first = _first_of_cubes(points, size)
        if len(first) <= max_points:
            return first
        size *= 1.25
