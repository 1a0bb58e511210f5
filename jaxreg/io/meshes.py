"""The vertices of meshes, OBJ and STL, through trimesh."""

import io
from pathlib import Path

import numpy as np

from jaxreg.io.arrays import as_points
from jaxreg.io.extras import reader, unreadable


def parse_obj(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The vertices of an OBJ file; of one with faces, those that a face uses.

    Returns:
        `(n, 3)` distinct vertices in the order of the file (within a material), float32
        if that loses nothing, else float64; no names of columns.

    Raises:
        InputError: if the data are no OBJ file or hold no vertices.
        MissingExtraError: if trimesh is not installed.
    """
    return _vertices(data, path, "obj"), ()


def parse_stl(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The corners of the triangles of an STL file, each once; else as `parse_obj`."""
    return _vertices(data, path, "stl"), ()


def _vertices(data: bytes, path: Path, kind: str) -> np.ndarray:
    trimesh = reader("trimesh", "OBJ and STL")
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data), file_type=kind, process=False, maintain_order=True
        )
        parts = [np.asarray(g.vertices, float) for g in scene.geometry.values()]
        points = np.concatenate(parts)
    except Exception as err:  # whatever a reader meets in damaged data
        raise unreadable(path, kind.upper(), err) from err
    # STL repeats a vertex for every triangle, OBJ for every material.
    _, first = np.unique(points, axis=0, return_index=True)
    points = points[np.sort(first)]
    narrow = points.astype(np.float32)
    exact = np.array_equal(narrow, points, equal_nan=True)
    return as_points(narrow if exact else points, str(path))
