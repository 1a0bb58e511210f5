"""Small valid files of every format that the package reads, and who reads them."""

import gzip
import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
from pypcd4 import pypcd4
from scipy.spatial.transform import Rotation

import jaxreg.io as files
from jaxreg.graph import PoseGraph


CLOUD = np.random.default_rng(7).normal(size=(24, 3)).astype(np.float32)


@dataclass(frozen=True)
class Sample:
    """A valid file.

    Attributes:
        name: of the file.
        data: its content.
        read: its reader, which returns arrays.
        counted: whether it says how much it holds, so that a cut is always seen.
    """

    name: str
    data: bytes
    read: Callable[[Path], list[np.ndarray]]
    counted: bool


def _points(path: Path) -> list[np.ndarray]:
    return files.read_scans(path)[1]


def _graph(read: Callable[[Path], PoseGraph]) -> Callable[[Path], list[np.ndarray]]:
    return lambda path: [np.asarray(read(path).T_i_j, np.float64)]


def _rows(form: str, points: np.ndarray = CLOUD, start: str = "") -> bytes:
    rows = [form.format(k, *row) for k, row in enumerate(points.tolist())]
    return (start + "\n".join(rows) + "\n").encode()


def _written(suffix: str, write: Callable[[Path], Any]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write(path)
        return path.read_bytes()


def _las(suffix: str) -> bytes:
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = CLOUD.T.astype(float)
    return _written(suffix, lambda path: las.write(str(path)))


def _e57(path: Path) -> None:
    data = {
        f"cartesian{a}": x.astype(float) for a, x in zip("XYZ", CLOUD.T, strict=True)
    }
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(data, name="a")


def _pcd(kind: str) -> bytes:
    cloud = pypcd4.PointCloud.from_xyz_points(CLOUD)
    return _written(".pcd", lambda path: cloud.save(path, pypcd4.Encoding(kind)))


def _mesh_ply(order: str) -> bytes:
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        f"ply\nformat {form} 1.0\ncomment made here\nelement vertex {len(CLOUD)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if not order:
        faces = "".join(f"3 {k} {k + 1} {k + 2}\n" for k in range(6)).encode()
        return head + _rows("{1:.9g} {2:.9g} {3:.9g} {0}") + faces
    vertex = np.zeros(len(CLOUD), [(a, f"{order}f4") for a in "xyz"] + [("red", "u1")])
    for k, axis in enumerate("xyz"):
        vertex[axis] = CLOUD[:, k]
    face = np.zeros(6, [("num", "u1"), ("ids", f"{order}i4", 3)])
    face["num"], face["ids"] = 3, np.arange(6)[:, None] + np.arange(3)
    return head + vertex.tobytes() + face.tobytes()


def _stl(text: bool) -> bytes:
    corners = CLOUD.reshape(-1, 3, 3)
    if not text:
        rows = np.zeros(
            len(corners), [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("t", "<u2")]
        )
        rows["c"] = corners
        return bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes()
    parts = ["solid a"]
    for triangle in corners.tolist():
        vertices = [f"vertex {x} {y} {z}" for x, y, z in triangle]
        parts += ["facet normal 0 0 1", "outer loop", *vertices, "endloop", "endfacet"]
    return "\n".join([*parts, "endsolid a", ""]).encode()


def _numpy(save: Callable[..., Any], *arrays: np.ndarray, **named: np.ndarray) -> bytes:
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def _motions(num: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(num, 4))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(num, 3))
    return T


def _graph_files() -> dict[str, tuple[bytes, Any]]:
    T = _motions(6)
    edges = [(k, (k + 1) % 6) for k in range(6)]
    graph = PoseGraph.from_edges(edges, T)
    g2o = _written(".g2o", lambda p: files.write_g2o(p, graph, T))
    flat = "".join(f"EDGE_SE2 {i} {j} {0.5 * i} 1 0.25 2 0 0 2 0 3\n" for i, j in edges)
    toro = "".join(f"EDGE2 {i} {j} {0.5 * i} 1 0.2 1 0 1 1 0 0\n" for i, j in edges)
    info = "".join(
        f"{i} {j} 6\n" + "".join(" ".join(map(str, row)) + "\n" for row in np.eye(6))
        for i, j in edges
    )
    conf = "".join(f"bmesh a{k}.ply {k} 0 1 0 0 0.6 0.8\n" for k in range(6))
    g2o_read = _graph(files.read_g2o)
    return {
        "a.g2o": (g2o, g2o_read),
        "b.g2o": (flat.encode(), g2o_read),
        "c.g2o.gz": (gzip.compress(g2o), g2o_read),
        "a.graph": (toro.encode(), _graph(files.read_toro)),
        "a.log": (
            _written(".log", lambda p: files.write_log(p, graph)),
            _graph(files.read_log),
        ),
        "a.info": (info.encode(), lambda p: list(files.read_info(p))[1:]),
        "a.kitti": (
            _written(".txt", lambda p: files.write_kitti(p, T)),
            lambda p: [np.asarray(files.read_kitti(p))],
        ),
        "a.tum": (
            _written(".tum", lambda p: files.write_tum(p, T)),
            lambda p: [np.asarray(files.read_tum(p)[1])],
        ),
        "a.conf": (
            conf.encode(),
            lambda p: [np.stack(list(files.read_conf(p).values()))],
        ),
    }


def samples() -> list[Sample]:
    """One of each kind."""
    spaced = "{1:.9g} {2:.9g} {3:.9g}"
    plain = {
        "a.xyz": _rows(spaced),
        "a.csv": _rows("{0},{1:.9g},{2:.9g},{3:.9g}", start="id,x,y,z\n"),
        "b.csv": _rows("{1:.6f};{2:.6f};{3:.6f}").replace(b".", b","),
        "a.txt": _rows("{1:.6f}\t{2:.6f}\t{3:.6f}").replace(b".", b","),
        "a.asc": _rows(spaced, start="# made here\n"),
        "b.txt": _rows("{1:.9g} {2:.9g}", CLOUD[:, :2]),
        "a.obj": _rows("v " + spaced),
        "a.bin": np.pad(CLOUD, [(0, 0), (0, 1)]).astype("<f4").tobytes(),
    }
    mesh = _rows("v " + spaced) + b"".join(b"f -1 -2 %d\n" % k for k in range(1, 25))
    counted = {
        "a.pts": _rows(spaced + " {0}", start=f"{len(CLOUD)}\n"),
        "b.obj": mesh,
        "a.npy": _numpy(np.save, CLOUD),
        "b.npy": _numpy(np.save, np.asfortranarray(CLOUD.astype(float))),
        "a.npz": _numpy(np.savez, a=CLOUD, b=CLOUD[:9]),
        "b.npz": _numpy(np.savez_compressed, a=CLOUD),
        "a.ply": _mesh_ply("<"),
        "b.ply": _mesh_ply(">"),
        "c.ply": _mesh_ply(""),
        "a.pcd": _pcd("ascii"),
        "b.pcd": _pcd("binary"),
        "c.pcd": _pcd("binary_compressed"),
        "a.las": _las(".las"),
        "a.laz": _las(".laz"),
        "a.e57": _written(".e57", _e57),
        "a.stl": _stl(False),
        "b.stl": _stl(True),
    }
    packed = {
        "d.xyz.gz": gzip.compress(plain["a.xyz"], mtime=0),
        "d.ply.gz": gzip.compress(counted["a.ply"], mtime=0),
        "d.las.gz": gzip.compress(counted["a.las"], mtime=0),
        "d.pcd.gz": gzip.compress(counted["b.pcd"], mtime=0),
    }
    found = [Sample(n, d, _points, False) for n, d in plain.items()]
    found += [Sample(n, d, _points, n != "b.obj") for n, d in counted.items()]
    found += [Sample(n, d, _points, True) for n, d in packed.items()]
    graphs = _graph_files().items()
    return found + [Sample(n, d, read, n.endswith(".gz")) for n, (d, read) in graphs]
