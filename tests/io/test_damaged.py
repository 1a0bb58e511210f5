"""Files that lie about themselves: refused at once, in one message of two lines."""

import gzip
import io
import os
import struct
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from jaxreg.io import InputError, read_g2o, read_points, read_tum, write_ply
from jaxreg.io.files import reading


laspy = pytest.importorskip("laspy")

CLOUD = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"
    b"property float y\nproperty float z\nelement face %d\n"
    b"property list uchar int vertex_indices\nend_header\n"
)
PCD = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 {count}\nWIDTH {num}\n"
    "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {num}\nDATA {kind}\n"
)


def _refused(path: Path | str, read=read_points) -> str:
    with pytest.raises(InputError) as caught:
        read(path)
    said = str(caught.value)
    assert str(path) in said.splitlines()[0]
    assert len(said.splitlines()) == 2
    return said


def _npy(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": True, "shape": shape}
    )
    return file.getvalue()


def _las(**changed: tuple[int, str, int]) -> bytes:
    file = io.BytesIO()
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = CLOUD.T.astype(float)
    las.write(file)
    data = bytearray(file.getvalue())
    for at, form, value in changed.values():
        struct.pack_into(form, data, at, value)
    return bytes(data)


LIARS = {
    "a.npz": _npy((0, 10**12)),
    "b.npz": _npy((10**12, 3)),
    "c.npz": _npy((3, 10**12)),
    "a.npy": _npy((10**12, 3)),
    "b.npy": _npy((0, 10**12)),
    "c.npy": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{",
    "d.npy": b"\x93NUMPY\x01\x00" + struct.pack("<H", 20) + b"{'descr': (((((((((((",
    "records.las": _las(count=(100, "<I", 2**32 - 1)),
    "points.las": _las(count=(107, "<I", 2**32 - 1)),
    "fewer.las": _las(count=(107, "<I", 19)),
    "faces.ply": PLY % 10**9 + bytes(24),
    "text.ply": PLY.replace(b"binary_little_endian", b"ascii") % 10**9 + b"0 0 0\n" * 2,
    "vertices.ply": PLY.replace(b"vertex 2", b"vertex 99999999") % 0 + bytes(24),
    "fewer.ply": PLY.replace(b"vertex 2", b"vertex 1") % 0 + bytes(24),
    "count.pcd": PCD.format(count=10**9, num=1, kind="ascii").encode() + b"1 2 3\n",
    "points.pcd": PCD.format(count=1, num=10**12, kind="binary").encode() + bytes(12),
    "fewer.pcd": PCD.format(count=1, num=1, kind="binary").encode() + bytes(36),
    "packed.pcd": PCD.format(count=1, num=9, kind="binary_compressed").encode()
    + struct.pack("<II", 2**31, 2**31),
    "triangles.stl": bytes(80) + struct.pack("<I", 10**9) + bytes(50),
    "cut.stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n",
    "short.obj": b"v 1 2\nv 1 2 3\n",
    "face.obj": b"v 1 2 3\nv 1 2 4\nv 0 0 1\nf 1 2 9\n",
    "one.xyz": b"7" * 3_000_000,
}


@pytest.mark.parametrize("name", list(LIARS))
def test_counts_that_the_file_cannot_hold_are_refused_at_once(
    tmp_path: Path, name: str
):
    path = tmp_path / name
    if name.endswith(".npz"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.npy", LIARS[name])
    else:
        path.write_bytes(LIARS[name])
    tracemalloc.start()
    _refused(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 30_000_000


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".npy", ".xyz.gz", ".e57"])
def test_pipes_devices_and_folders_are_no_files(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    os.mkfifo(path)
    assert "a named pipe" in _refused(path)
    os.unlink(path)
    os.symlink("/dev/zero", path)
    assert "a device" in _refused(path)
    os.unlink(path)
    path.symlink_to(tmp_path / "none")
    assert "no such file" in _refused(path)


def test_pipes_are_no_graphs_or_poses(tmp_path: Path):
    os.mkfifo(tmp_path / "a.g2o")
    for read in (read_g2o, read_tum):
        assert "a named pipe" in _refused(tmp_path / "a.g2o", read)


@pytest.mark.parametrize("suffix", [".xyz.gz", ".ply.gz"])
def test_a_bomb_is_refused_by_its_ratio(tmp_path: Path, suffix: str):
    path = tmp_path / f"bomb{suffix}"
    with gzip.open(path, "wb") as file:
        file.write(b"ply\n" if "ply" in suffix else b"")
        for _ in range(100):
            file.write(b"1 2 3\n" * 200_000)
    assert path.stat().st_size < 600_000
    assert "200 times its size" in _refused(path)


def test_what_compresses_well_is_no_bomb(tmp_path: Path):
    path = tmp_path / "flat.xyz.gz"
    path.write_bytes(gzip.compress(b"1 2 3\n" * 20_000))
    assert read_points(path).shape == (20_000, 3)


@pytest.mark.parametrize("kind", ["npy", "npz", "ply", "xyz", "obj"])
def test_reading_takes_at_most_four_times_what_is_kept(tmp_path: Path, kind: str):
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    path = tmp_path / f"a.{kind}"
    if kind == "npy":
        np.save(path, points)
    elif kind == "npz":
        np.savez(path, points)
    elif kind == "ply":
        write_ply(path, points)
    else:
        start = "v " if kind == "obj" else ""
        rows = (f"{start}{x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in points)
        path.write_text("".join(rows))
    read_points(path)  # imports and caches
    tracemalloc.start()
    found = read_points(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(found, points)
    assert most <= 4 * found.nbytes + 1_500_000  # of any size: buffers


class PanicException(BaseException):
    """As extension modules written in Rust raise it."""


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OverflowError("too large"),
        NotImplementedError("compression 99"),
        RecursionError(),
        PanicException("index out of bounds"),
        OSError("no errno"),
        SyntaxError(),
    ],
)
def test_whatever_a_reader_raises_is_one_message(tmp_path: Path, error: BaseException):
    with (
        pytest.raises(InputError, match=r"a\.ply: .*\n.*\."),
        reading(tmp_path / "a.ply", "PLY"),
    ):
        raise error


def test_interruptions_pass_the_guard(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), reading(tmp_path / "a", "PLY"):
        raise KeyboardInterrupt


def test_encrypted_and_unknown_archives(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez(path, CLOUD)
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02")
    data[6] |= 1  # says that the entry is encrypted
    data[at + 8] |= 1
    path.write_bytes(data)
    assert "password" in _refused(path)
    data[6] &= ~1
    data[at + 8] &= ~1
    struct.pack_into("<H", data, at + 10, 99)
    struct.pack_into("<H", data, 8, 99)
    path.write_bytes(data)
    assert "compression" in _refused(path)
    (tmp_path / "a.7z").write_bytes(b"7z\xbc\xaf\x27\x1c")
    assert "unknown kind of file .7z" in _refused(tmp_path / "a.7z")
    inner = gzip.compress(b"1 2 3\n")
    (tmp_path / "a.xyz.gz").write_bytes(gzip.compress(inner))
    assert "compressed twice" in _refused(tmp_path / "a.xyz.gz")


def test_large_faces_cost_no_memory(tmp_path: Path):
    faces = np.zeros(200_000, dtype=[("n", "u1"), ("ids", "<i4", 3)])
    faces["n"] = 3
    path = tmp_path / "mesh.ply"
    path.write_bytes(PLY % len(faces) + CLOUD[:2].tobytes() + faces.tobytes())
    tracemalloc.start()
    np.testing.assert_array_equal(read_points(path), CLOUD[:2])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2_000_000
    path.write_bytes(path.read_bytes()[:-1])
    assert "face" in _refused(path)


@pytest.mark.skipif(sys.platform == "win32", reason="modes of files")
def test_a_file_that_may_not_be_read(tmp_path: Path):
    if os.geteuid() == 0:
        pytest.skip("root may read all")
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    path.chmod(0)
    assert "Permission" in _refused(path)
