"""What a g2o file holds, as NumPy arrays: JAX is not needed to tell it."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o_lines import Lines, Rows


#: Numbers after the id, and after both ids, of frames and of motions between them.
VERTEX = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7}
EDGE = {"EDGE_SE2": 9, "EDGE_SE3:QUAT": 28}
#: How many ids there are on each kind of line, and numbers after them.
KNOWN = {
    "PARAMS_SE3OFFSET": (1, 7),
    "EDGE_PRIOR_SE2": (1, 9),
    "EDGE_PRIOR_SE2_XY": (1, 5),
    "EDGE_SE3_PRIOR": (2, 28),
    "EDGE_SE3_XYZPRIOR": (2, 9),
}
KINDS = (*VERTEX, *EDGE, *KNOWN, "FIX")


class File(NamedTuple):
    """Its lines.

    Attributes:
        lines: all of them.
        ids: `(v,)` of the frames, those named by edges alone included.
        vertices: lines of frames.
        edges: lines of motions.
        dim: 2 or 3.
    """

    lines: Lines
    ids: np.ndarray
    vertices: Rows
    edges: Rows
    dim: int

    def places(self) -> np.ndarray | None:
        """Which frame each vertex is; None unless each frame has one.

        Raises:
            InputError: if a frame has two.
        """
        where = np.searchsorted(self.ids, self.vertices.ids[:, 0])
        if len(np.unique(where)) != len(where):
            raise InputError(f"{self.lines.path}: a vertex id occurs twice.")
        return where if len(where) == len(self.ids) else None


def parse(path: Path) -> File:
    """What a file holds; its lines of unknown kinds are counted by a warning."""
    lines = Lines(path)
    found = lines.found
    dims = [d for d in (2, 3) if any(f"SE{d}" in tag for tag in found)]
    if len(dims) != 1:
        what = "2D and 3D lines in one file" if dims else "no SE2 or SE3 line"
        raise InputError(
            f"{path}: {what}; this is no pose graph.\n"
            "Give a g2o file of one dimension; scans go to: jaxreg multiview"
        )
    unknown = {tag: len(rows) for tag, rows in found.items() if tag not in KINDS}
    if unknown:
        counts = ", ".join(f"{n} x {tag}" for tag, n in unknown.items())
        warnings.warn(
            f"{path}: skipped lines of unknown kinds ({counts}).", stacklevel=3
        )
    d = dims[0]
    vertex, edge = list(VERTEX)[d - 2], list(EDGE)[d - 2]
    vertices = lines.rows(vertex, 1, VERTEX[vertex])
    edges = lines.rows(edge, 2, EDGE[edge])
    ids = np.unique(np.concatenate([vertices.ids.ravel(), edges.ids.ravel()]))
    return File(lines, ids, vertices, edges, d)
