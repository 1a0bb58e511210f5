"""PCD: ASCII and binary by blocks; compressed ones whole, through pypcd4."""

import io
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.extras import require
from jaxreg.io.moved import lines, records
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.columns import NORMALS, named
from jaxreg.io.points.pcd import header_lines
from jaxreg.io.quaternions import motions_from_xyzw, xyzw_from_rotations


def move_pcd(path: Path, out: BufferedIOBase, moving: Moving) -> None:
    """Writes the file again, its viewpoint moved, too; compressed ones as binary."""
    pypcd4 = require("pypcd4", "Writing PCD")
    with path.open("rb") as file:
        text = header_lines(file)
        header = pypcd4.MetaData.parse_header(text)
        start, ascii_rows = file.tell(), header.data == pypcd4.Encoding.ASCII
        names = [a for a in "xyz" if a in header.fields][: moving.dim]
        normals = named(header.fields, NORMALS)
        dtype = header.build_dtype()
        if header.data == pypcd4.Encoding.BINARY_COMPRESSED:
            file.seek(0)
            rows = pypcd4.PointCloud.from_fileobj(file).pc_data
            file = io.BytesIO(np.ascontiguousarray(rows).tobytes())
            text[-1], start = "DATA binary", 0
        wide = any(dtype[a] == np.float64 for a in names)
        file.seek(start)
        wide |= moving.goes_far(_points(file, header, dtype, names, ascii_rows))
        out.write(_head(text, header, names, wide, moving).encode())
        file.seek(start)
        if ascii_rows:
            order: list[str] = list(dtype.names or ())
            places = [order.index(a) for a in names]
            turned = None if normals is None else [order.index(a) for a in normals]
            cells = (line.decode("latin1").split() for line in file if line.strip())
            form = (lines.WIDE if wide else lines.NARROW).__mod__
            for row in lines.move_cells(cells, moving, places, turned, form):
                out.write((" ".join(row) + "\n").encode("latin1"))
            return
        new = records.widened(dtype, names) if wide else dtype
        for rows in records.blocks(file, header.points, dtype):
            out.write(records.move_rows(rows, new, moving, names, normals).tobytes())


def _points(
    file: Any, header: Any, dtype: np.dtype, names: list[str], ascii_rows: bool
) -> Iterator[np.ndarray]:
    if not ascii_rows:
        for rows in records.blocks(file, header.points, dtype):
            yield records.columns(rows, names)
        return
    places = [list(dtype.names or ()).index(a) for a in names]
    yield np.loadtxt((x for x in file if x.strip()), usecols=places, ndmin=2)


def _head(
    text: list[str], header: Any, names: list[str], wide: bool, moving: Moving
) -> str:
    """With coordinates as float64 where they are, and the viewpoint moved."""
    out = []
    for line in text:
        word, *rest = line.split() or [""]
        if wide and word in ("SIZE", "TYPE"):
            new = {"SIZE": "8", "TYPE": "F"}[word]
            pairs = zip(header.fields, rest, strict=True)
            line = " ".join([word, *(new if f in names else x for f, x in pairs)])
        if word == "VIEWPOINT" and len(rest) == 7 and moving.dim == 3:
            line = f"VIEWPOINT {_viewpoint(np.array(rest, np.float64), moving)}"
        out.append(line)
    return "\n".join(out) + "\n"


def _viewpoint(old: np.ndarray, moving: Moving) -> str:
    """Position and wxyz quaternion of the scanner."""
    T = motions_from_xyzw(old[None, :3], old[None, [4, 5, 6, 3]])
    R = moving.T[None, :3, :3] / moving.scale @ T[:, :3, :3]
    x, y, z, w = xyzw_from_rotations(R)[0]
    t = moving.points(T[:, :3, 3])[0]
    return " ".join(f"{v:.9g}" for v in (*t, w, x, y, z))
