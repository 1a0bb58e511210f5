"""LAS and LAZ through laspy: every dimension and record, offsets for where they go."""

import copy
import itertools
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from jaxreg.io.extras import require
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.columns import NORMALS, named


_CHUNK = 500_000
_MOST = 2_000_000_000  # steps of a scale that an int32 holds


def move_las(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes the file again by chunks, packed if it was; scales as they were."""
    laspy = require("laspy", "Writing LAS and LAZ")
    require("lazrs", "Writing LAZ")
    with laspy.open(path) as file:
        header = copy.deepcopy(file.header)
        ends = zip(file.header.mins, file.header.maxs, strict=True)
        corners = moving.points(np.array(list(itertools.product(*ends))))
        low, high = corners.min(axis=0), corners.max(axis=0)
        header.offsets = np.floor(low)
        steps = (high - header.offsets).max() / _MOST
        header.scales = np.maximum(file.header.scales * min(1, moving.scale), steps)
        packed = file.header.are_points_compressed
        normals = named(list(header.point_format.dimension_names), NORMALS)
        with laspy.open(
            out, mode="w", header=header, do_compress=packed, closefd=False
        ) as writer:
            for chunk in file.chunk_iterator(_CHUNK):
                points = moving.points(np.stack([chunk.x, chunk.y, chunk.z], axis=1))
                if normals is not None:
                    old = np.stack([chunk[name] for name in normals], axis=1)
                    for name, column in zip(
                        normals, moving.directions(old).T, strict=True
                    ):
                        chunk[name] = column
                chunk.scales, chunk.offsets = header.scales, header.offsets
                chunk.x, chunk.y, chunk.z = points.T
                writer.write_points(chunk)
            if file.header.version.minor >= 4 and file.evlrs:
                writer.write_evlrs(file.evlrs)
