"""Files written again, moved: everything of them is there, and in its place."""

import gzip
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest

from jaxreg import io
from jaxreg.io import InputError, read_points, write_moved, write_points
from jaxreg.io.points.read import read_named


RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(50, 3))
NORMALS = RNG.normal(size=(50, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)
INTENSITY = RNG.random(50).astype(np.float32)
T = np.eye(4)
T[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]
T[:3, 3] = [1, -2, 3]
FAR = T.copy()
FAR[:3, 3] = [466123.25, 5427001.5, 100.0]
PLY = """\
ply
format {}
comment made by hand
element camera 1
property float view
property list uchar int places
element vertex 3
property uchar flag
property float x
property float y
property float z
property float nx
property float ny
property float nz
element face 1
property list uchar int vertex_indices
end_header
"""
ROWS = [(7, 1, 2, 3, 0, 0, 1), (8, 4, 5, 6, 0, 1, 0), (9, 0, 0, 0, 1, 0, 0)]


def moved(x: np.ndarray, motion: np.ndarray = T) -> np.ndarray:
    return x @ motion[:3, :3].T + motion[:3, 3]


def _ply(folder: Path, form: str) -> Path:
    path = folder / "a.ply"
    head = PLY.format(form).encode()
    if form.startswith("ascii"):
        rows = "\n".join(" ".join(map(str, row)) for row in ROWS)
        path.write_bytes(head + f"0.5 2 8 9\n{rows}\n3 0 1 2\n".encode())
        return path
    order = "<" if "little" in form else ">"
    kinds = [("flag", "u1")] + [(f"f{k}", f"{order}f4") for k in range(6)]
    camera = np.array([0.5], f"{order}f4").tobytes() + b"\x02"
    camera += np.array([8, 9], f"{order}i4").tobytes()
    face = b"\x03" + np.array([0, 1, 2], f"{order}i4").tobytes()
    path.write_bytes(head + camera + np.array(ROWS, kinds).tobytes() + face)
    return path


@pytest.mark.parametrize(
    "form", ["ascii 1.0", "binary_little_endian 1.0", "binary_big_endian 1.0"]
)
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("motion", [T, FAR], ids=["near", "far"])
def test_a_ply_file_keeps_all_its_elements(
    tmp_path: Path, form: str, packed: bool, motion: np.ndarray
):
    source = _ply(tmp_path, form)
    if packed:
        source.with_suffix(".ply.gz").write_bytes(gzip.compress(source.read_bytes()))
        source = source.with_suffix(".ply.gz")
    out = tmp_path / source.name.replace("a", "b")
    write_moved(out, source, motion)
    data = out.read_bytes()
    plain = tmp_path / "plain.ply"
    plain.write_bytes(gzip.decompress(data) if packed else data)
    found = plyfile.PlyData.read(plain)
    assert found.comments == ["made by hand"]
    assert [e.name for e in found] == ["camera", "vertex", "face"]
    assert found["camera"]["view"] == 0.5
    assert found["camera"]["places"][0].tolist() == [8, 9]
    assert found["face"]["vertex_indices"][0].tolist() == [0, 1, 2]
    vertex, rows = found["vertex"], np.array(ROWS, float)
    assert vertex["flag"].tolist() == [7, 8, 9]
    points = np.stack([vertex[a] for a in "xyz"], axis=1)
    # Coordinates in a map need the digits of float64.
    assert points.dtype.itemsize == (8 if motion is FAR else 4)
    np.testing.assert_allclose(points, moved(rows[:, 1:4], motion), rtol=1e-6, atol=0)
    exact = moved(rows[:, 1:4], motion)
    np.testing.assert_allclose(points, exact, rtol=0, atol=1e-6)
    normals = np.stack([vertex[a] for a in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(normals, rows[:, 4:] @ motion[:3, :3].T, atol=1e-6)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("motion", [T, FAR], ids=["near", "far"])
def test_a_pcd_file_keeps_its_fields_and_moves_its_viewpoint(
    tmp_path: Path, encoding: str, motion: np.ndarray
):
    pypcd4 = pytest.importorskip("pypcd4")
    fields = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "intensity", "ring")
    kinds = [np.float32] * 7 + [np.uint16]
    table = np.column_stack([CLOUD, NORMALS, INTENSITY, np.arange(50)])
    cloud = pypcd4.PointCloud.from_points(table.astype(np.float32), fields, kinds)
    cloud.metadata.viewpoint = (1, 2, 3, 1, 0, 0, 0)
    cloud.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding(encoding))
    write_moved(tmp_path / "b.pcd", tmp_path / "a.pcd", motion)
    found = pypcd4.PointCloud.from_path(tmp_path / "b.pcd")
    assert found.fields == fields
    assert found.pc_data["x"].dtype == (np.float64 if motion is FAR else np.float32)
    exact = moved(table[:, :3].astype(np.float32), motion)
    np.testing.assert_allclose(found.numpy(("x", "y", "z")), exact, rtol=0, atol=2e-6)
    normals = found.numpy(("normal_x", "normal_y", "normal_z"))
    np.testing.assert_allclose(normals, NORMALS @ motion[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(found.pc_data["intensity"], INTENSITY, rtol=1e-6)
    assert found.pc_data["ring"].tolist() == list(range(50))
    view = np.array(found.metadata.viewpoint, float)
    np.testing.assert_allclose(
        view[:3], moved(np.array([1.0, 2, 3]), motion), rtol=1e-8
    )


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_las_file_keeps_its_dimensions_and_gets_a_fitting_offset(
    tmp_path: Path, suffix: str
):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = [0.001] * 3, [0, 0, 0]
    header.add_extra_dim(laspy.ExtraBytesParams("nx", np.float32))
    header.add_extra_dim(laspy.ExtraBytesParams("ny", np.float32))
    header.add_extra_dim(laspy.ExtraBytesParams("nz", np.float32))
    header.vlrs.append(laspy.VLR("somebody", 7, "kept", b"abc"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = CLOUD.T
    las.nx, las.ny, las.nz = NORMALS.T
    las.classification = np.arange(50) % 8
    las.gps_time = np.arange(50) / 7
    las.red = COLORS[:, 0].astype(np.uint16) * 256
    las.write(tmp_path / f"a.{suffix}")
    write_moved(tmp_path / f"b.{suffix}", tmp_path / f"a.{suffix}", FAR)
    before, found = (laspy.read(tmp_path / f"{x}.{suffix}") for x in "ab")
    np.testing.assert_allclose(found.xyz, moved(before.xyz, FAR), rtol=0, atol=6e-4)
    np.testing.assert_array_equal(found.header.scales, [0.001] * 3)
    np.testing.assert_allclose(found["nx"], (NORMALS @ T[:3, :3].T)[:, 0], atol=1e-6)
    for name in ("classification", "gps_time", "red", "intensity", "return_number"):
        np.testing.assert_array_equal(found[name], before[name])
    assert found.header.vlrs.get_by_id("somebody")[0].record_data == b"abc"
    np.testing.assert_allclose(found.header.mins, found.xyz.min(axis=0), atol=1e-3)


def _e57(path: Path) -> list[np.ndarray]:
    pye57 = pytest.importorskip("pye57")
    clouds = []
    with pye57.E57(str(path), mode="w") as file:
        for k in range(2):
            data: dict[str, Any] = dict(zip(("x", "y", "z"), CLOUD.T + k, strict=True))
            data = {f"cartesian{a.upper()}": x.copy() for a, x in data.items()}
            data["intensity"] = INTENSITY
            for c, name in enumerate(("colorRed", "colorGreen", "colorBlue")):
                data[name] = COLORS[:, c].copy()
            half = np.sqrt(0.5)
            rotation = np.array([half, 0, 0, half])
            file.write_scan_raw(
                data, name=f"s{k}", rotation=rotation, translation=np.array([1.0, 2, 3])
            )
        lib, image = pye57.libe57, pye57.libe57.StructureNode(file.image_file)
        file.image_file.root()["images2D"].append(image)
        blob = lib.BlobNode(file.image_file, 5)
        image.set("jpegImage", blob)
        blob.write(np.frombuffer(b"image", np.uint8).copy(), 0, 5)
    for k in range(2):
        clouds.append(read_points(f"{path}:s{k}"))
    return clouds


def test_an_e57_file_keeps_its_scans_and_gets_other_poses(tmp_path: Path):
    pye57 = pytest.importorskip("pye57")
    clouds = _e57(tmp_path / "a.e57")
    motions = {"s0": T, "s1": FAR}
    write_moved(tmp_path / "b.e57", tmp_path / "a.e57", motions)
    for k, motion in enumerate((T, FAR)):
        found = read_points(f"{tmp_path}/b.e57:s{k}")
        np.testing.assert_allclose(found, moved(clouds[k], motion), rtol=0, atol=1e-6)
    with pye57.E57(str(tmp_path / "b.e57")) as file:
        raw = file.read_scan_raw(1)
        np.testing.assert_array_equal(raw["colorRed"], COLORS[:, 0])
        np.testing.assert_array_equal(raw["intensity"], INTENSITY)
        images = file.image_file.root()["images2D"]
        assert bytes(images[0]["jpegImage"].read_buffer()) == b"image"
    write_moved(tmp_path / "c.e57", tmp_path / "a.e57", {"s1": T})
    assert io.read_scans(tmp_path / "c.e57")[0] == ["c"]
    scaled = T @ np.diag([2.0, 2, 2, 1])
    with pytest.raises(InputError, match="no scale"):
        write_moved(tmp_path / "d.e57", tmp_path / "a.e57", {"s1": scaled})


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        (
            "a.xyz",
            "# made\n1.00 2.00 3.00 5\n4 5 6 7\n",
            "# made\n11.000 2.000 3.000 5\n",
        ),
        (
            "a.csv",
            "z,x,y,class\n3,1.5,2,road\n",
            "z,x,y,class\n3.000,11.500,2.000,road\n",
        ),
        ("a.csv", "x;y;z\n1,25;2,5;3,0\n", "x;y;z\n11,250;2,500;3,000\n"),
        ("a.csv", "x;y;z;name\n1.25;2;3;a.b\n", "x;y;z;name\n11.250;2.000;3.000;a.b\n"),
        (
            "a.pts",
            "2\n1 2 3 -5 1 2 3\n4 5 6 -9 4 5 6\n",
            "2\n11.000 2.000 3.000 -5 1 2 3\n",
        ),
        ("a.txt", "1e0 2 3\nnan 5 6\n", "11 2 3\nnan 5 6\n"),
        ("a.obj", "v 1 2 3 0.5 0.5 0.5\nvn 0 0 1\nf 1 1 1\n", "v 11 2 3 0.5 0.5 0.5\n"),
    ],
)
def test_text_keeps_its_dialect(tmp_path: Path, name: str, text: str, wanted: str):
    (tmp_path / name).write_text(text)
    shift = np.eye(4)
    shift[0, 3] = 10
    out = tmp_path / f"b{Path(name).suffix}"
    write_moved(out, tmp_path / name, shift)
    found = out.read_text()
    assert found.startswith(wanted)
    assert len(found.splitlines()) == len(text.splitlines())


def test_normals_of_text_and_of_meshes_turn(tmp_path: Path):
    (tmp_path / "a.csv").write_text(
        "x,y,z,nx,ny,nz\n1,2,3,0.000000,0.000000,1.000000\n"
    )
    write_moved(tmp_path / "b.csv", tmp_path / "a.csv", T)
    row = np.loadtxt(tmp_path / "b.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(row[3:], T[:3, 2], atol=1e-6)
    (tmp_path / "a.obj").write_text("v 1 2 3\nvn 0 0 1\n")
    write_moved(tmp_path / "b.obj", tmp_path / "a.obj", T)
    lines = (tmp_path / "b.obj").read_text().splitlines()
    np.testing.assert_allclose(np.array(lines[1].split()[1:], float), T[:3, 2])


@pytest.mark.parametrize("binary", [True, False])
def test_triangles_are_moved_with_their_normals(tmp_path: Path, binary: bool):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((1, 2, 3))
    kind = "stl" if binary else "stl_ascii"
    (tmp_path / "a.stl").write_bytes(
        data if isinstance(data := box.export(file_type=kind), bytes) else data.encode()
    )
    write_moved(tmp_path / "b.stl", tmp_path / "a.stl", T)
    found = trimesh.load(tmp_path / "b.stl")
    box.apply_transform(T)
    np.testing.assert_allclose(found.triangles, box.triangles, atol=1e-5)
    np.testing.assert_allclose(found.face_normals, box.face_normals, atol=1e-5)


def test_arrays_keep_their_width_where_it_suffices(tmp_path: Path):
    narrow = CLOUD.astype(np.float32)
    np.save(tmp_path / "a.npy", narrow)
    for motion, kind in ((T, np.float32), (FAR, np.float64)):
        write_moved(tmp_path / "b.npy", tmp_path / "a.npy", motion)
        found = np.load(tmp_path / "b.npy")
        assert found.dtype == kind
        np.testing.assert_allclose(found, moved(narrow, motion), rtol=0, atol=2e-6)
    np.savez(tmp_path / "a.npz", one=CLOUD, two=narrow, three=CLOUD[:9, :2])
    flat = np.eye(3)
    flat[0, 2] = 4
    write_moved(tmp_path / "b.npz", tmp_path / "a.npz", {"one": T, "three": flat})
    found = np.load(tmp_path / "b.npz")
    assert sorted(found) == ["one", "three"]
    np.testing.assert_allclose(found["one"], moved(CLOUD))
    np.testing.assert_allclose(found["three"], CLOUD[:9, :2] + [4, 0])


def test_lidar_frames_keep_their_intensity(tmp_path: Path):
    rows = np.concatenate([CLOUD, CLOUD[:, :1]], axis=1).astype("<f4")
    rows.tofile(tmp_path / "a.bin")
    write_moved(tmp_path / "b.bin", tmp_path / "a.bin", T)
    found = np.fromfile(tmp_path / "b.bin", "<f4").reshape(-1, 4)
    np.testing.assert_allclose(found[:, :3], moved(CLOUD), atol=1e-5)
    np.testing.assert_array_equal(found[:, 3], rows[:, 3])


def test_what_cannot_be_moved_leaves_no_file(tmp_path: Path):
    np.save(tmp_path / "a.npy", CLOUD)
    (tmp_path / "cut.ply").write_bytes(b"ply\n")
    for out, source, motion, error in (
        ("b.ply", "a.npy", T, "wanted the suffix .npy"),
        ("b.npy", "a.npy", np.ones((4, 4)), "wanted rigid motions"),
        ("b.npy", "a.npy", {"a": T}, "wanted one motion"),
        ("b.ply", "cut.ply", T, "not a complete PLY file"),
    ):
        with pytest.raises(ValueError, match=error):
            write_moved(tmp_path / out, tmp_path / source, motion)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npy", "cut.ply"]


def test_memory_does_not_grow_with_the_file(tmp_path: Path):
    peaks = []
    for num in (2_000_000, 6_000_000):
        np.save(tmp_path / "a.npy", np.zeros((num, 3), np.float32))
        tracemalloc.start()
        write_moved(tmp_path / "b.npy", tmp_path / "a.npy", T)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.las", "a.laz", "a.xyz", "a.csv"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_are_written_with_what_belongs_to_them(
    tmp_path: Path, name: str, dtype: Any
):
    path = tmp_path / name
    far = np.array([466123.0, 5427001.0, 3]) * (dtype is np.float64)
    points = (CLOUD + far).astype(dtype)
    write_points(path, points, colors=COLORS, normals=NORMALS, intensity=INTENSITY)
    found = read_points(path)
    exact = name[-3:] not in ("las", "laz")
    np.testing.assert_allclose(
        found.astype(dtype), points, rtol=0, atol=0 if exact else 1e-6
    )
    (scan,) = read_named(path).values()
    lower = {field.lower() for field in scan.fields}
    assert {"red", "rgb"} & lower
    assert {"nx", "normal_x"} & lower
    assert "intensity" in lower
    write_points(path, points[:, :2])
    assert len(read_points(path)) == 50


def test_points_that_a_format_cannot_hold_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="coordinates alone"):
        write_points(tmp_path / "a.npy", CLOUD, colors=COLORS)
    with pytest.raises(InputError, match="no kind of file"):
        write_points(tmp_path / "a.doc", CLOUD)
    with pytest.raises(ValueError, match=r"normals: wanted shape \(50, 3\)"):
        write_points(tmp_path / "a.ply", CLOUD, normals=NORMALS[:3])
    assert list(tmp_path.iterdir()) == []
