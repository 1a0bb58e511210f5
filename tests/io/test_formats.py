"""Formats of scanners and meshes, on files that other programs and libraries wrote."""

import gzip
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxreg.app.cli.main import main
from jaxreg.io import InputError, MissingExtraError, read_points, read_scans
from jaxreg.io.points.read import read_named


laspy = pytest.importorskip("laspy")
pye57 = pytest.importorskip("pye57")
trimesh = pytest.importorskip("trimesh")
pypcd4 = pytest.importorskip("pypcd4")

# Numbers that float32 holds, as some writers know nothing else.
CLOUD = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32).astype(float)
SITE = np.array([466123.0, 5427001.0, 112.0])
FAR = CLOUD + SITE

# As in the description of the format by the Point Cloud Library.
PCD = """\
# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA ascii
0.93773 0.33763 0 4.2108e+06
0.90805 nan 0 4.2108e+06
0.81915 0.32 0 4.2108e+06
"""

# A line of each kind that the specification of Wavefront has for polygons.
OBJ = """\
# four corners
mtllib none.mtl
o pyramid
v 0 0 0
v 1.5 0 0 1.0
v 0 2.25 0
v 0.1 0.2 3
vt 0 0
vt 1 1
vn 0 0 1
g sides
usemtl stone
s off
f 1/1/1 2/2/1 3/1/1
f 1//1 3//1 \\
  4//1
f -4 -3 -1
"""
CORNERS = [[0, 0, 0], [1.5, 0, 0], [0, 2.25, 0], [0.1, 0.2, 3]]


def _write_las(path: Path, points: np.ndarray) -> None:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = [466000, 5427000, 0], [1e-4] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))


def _write_e57(
    path: Path,
    names: list[str],
    rotation: tuple[float, ...] = (1, 0, 0, 0),
    translation: np.ndarray = SITE,
) -> None:
    """Scans of the same points; `rotation` is a quaternion wxyz."""
    data = {f"cartesian{a}": x.copy() for a, x in zip("XYZ", CLOUD.T, strict=True)}
    pose = {"rotation": np.array(rotation, float), "translation": translation}
    with pye57.E57(str(path), mode="w") as file:
        for name in names:
            file.write_scan_raw(data, name=name, **pose)


def _gzip(path: Path) -> Path:
    packed = path.with_name(path.name + ".gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    return packed


@pytest.mark.parametrize("kind", ["ascii", "binary", "compressed"])
def test_pcd_that_open3d_wrote(tmp_path: Path, kind: str):
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(CLOUD))
    cloud.normals = o3d.utility.Vector3dVector(CLOUD)
    path = tmp_path / "a.pcd"
    o3d.io.write_point_cloud(
        str(path), cloud, write_ascii=kind == "ascii", compressed=kind == "compressed"
    )
    points = read_points(path)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, CLOUD.astype(np.float32), rtol=1e-6)


def test_pcd_of_the_specification(tmp_path: Path):
    (tmp_path / "a.pcd").write_text(PCD)
    expected = np.array(
        [[0.93773, 0.33763, 0], [0.90805, np.nan, 0], [0.81915, 0.32, 0]], np.float32
    )
    for file in (tmp_path / "a.pcd", _gzip(tmp_path / "a.pcd")):
        np.testing.assert_array_equal(read_points(file), expected)


def test_lidar_frames_of_kitti(tmp_path: Path):
    rows = np.random.default_rng(0).normal(size=(50, 4)).astype("<f4")
    path = tmp_path / "000000.bin"
    rows.tofile(path)
    found = read_points(path)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, rows[:, :3])
    assert read_named(path)["000000"].fields == ("x", "y", "z", "intensity")
    names, _ = read_scans(tmp_path)
    assert names == ["000000"]
    for other in (rows.tobytes() + b"1234", rows.view("<u4").astype("<f4").tobytes()):
        path.write_bytes(other)
        with pytest.raises(InputError, match="those of KITTI are read"):
            read_points(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_keeps_the_digits_of_map_coordinates(tmp_path: Path, suffix: str):
    path = tmp_path / f"a.{suffix}"
    _write_las(path, FAR)
    points = read_points(path)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, FAR, rtol=0, atol=0.51e-4)


def test_e57_of_one_scan_has_the_name_of_the_file(tmp_path: Path):
    _write_e57(tmp_path / "room.e57", ["Scan 1"])
    names, (points,) = read_scans(tmp_path)
    assert names == ["room"]
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, FAR, rtol=0, atol=1e-9)


def test_e57_of_several_scans_is_an_archive(tmp_path: Path):
    path = tmp_path / "rooms.e57"
    _write_e57(path, ["hall", "attic"], translation=np.zeros(3))
    names, scans = read_scans(path)
    assert names == ["hall", "attic"]
    np.testing.assert_array_equal(scans[1], CLOUD)
    np.testing.assert_array_equal(read_points(f"{path}:hall"), CLOUD)
    with pytest.raises(InputError, match="holds 2 scans: hall, attic"):
        read_points(path)
    with pytest.raises(InputError, match="has no scan cellar"):
        read_points(f"{path}:cellar")


def test_e57_poses_bring_the_scans_into_the_frame_of_the_file(tmp_path: Path):
    about_z = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    _write_e57(tmp_path / "a.e57", ["a"], about_z, np.array([1.0, 2.0, 3.0]))
    x, y, z = CLOUD.T
    expected = np.stack([1 - y, 2 + x, 3 + z], axis=1)
    np.testing.assert_allclose(read_points(tmp_path / "a.e57"), expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_that_trimesh_wrote_has_each_vertex_once(tmp_path: Path, kind: str):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    sphere.export(tmp_path / "a.stl", file_type=kind)
    points = read_points(tmp_path / "a.stl")
    found, expected = (np.unique(x, axis=0) for x in (points, sphere.vertices))
    assert len(points) == len(found) == 42
    np.testing.assert_allclose(found[:, 0], expected[:, 0], atol=1e-7)


def test_obj_of_the_specification(tmp_path: Path):
    (tmp_path / "a.obj").write_text(OBJ)
    np.testing.assert_array_equal(read_points(tmp_path / "a.obj"), CORNERS)
    bare = "".join(s + "\n" for s in OBJ.splitlines() if s.startswith("v "))
    (tmp_path / "b.obj").write_text(bare.replace(" 1.0", ""))
    np.testing.assert_array_equal(read_points(_gzip(tmp_path / "b.obj")), CORNERS)


CUT = {
    "a.pcd": PCD[:-40].encode(),
    "b.pcd": PCD.rsplit("\n", 2)[0].encode(),
    "c.pcd": PCD.replace("FIELDS x y", "FIELDS a b").encode(),
    "d.pcd": b"junk\n",
    "a.las": b"LASF" + bytes(400),
    "b.laz": b"junk",
    "a.e57": b"ASTM-E57" + bytes(300),
    "b.e57": b"junk",
    "a.obj": b"junk\n",
    "b.obj": b"v 1 2 3\nv 1 a 2\n",
    "c.obj": b"v 1 2 3\nv 3 4 4\nf 1 2 9\n",
    "a.stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0",
    "b.stl": bytes(80) + (99).to_bytes(4, "little") + bytes(60),
}


@pytest.mark.parametrize("name", list(CUT))
def test_damaged_files_are_named_in_two_lines(tmp_path: Path, name: str):
    path = tmp_path / name
    path.write_bytes(CUT[name])
    with pytest.raises(InputError) as caught:
        read_points(path)
    lines = str(caught.value).splitlines()
    assert str(path) in lines[0]
    assert len(lines) <= 2


@pytest.mark.parametrize("kind", ["las", "laz", "e57", "ascii", "binary", "packed"])
def test_of_large_scans_every_so_many_points_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
):
    for chunk in ("las._CHUNK", "e57._CHUNK", "thinning._ROWS"):
        monkeypatch.setattr(f"jaxreg.io.points.{chunk}", 8)
    suffix = kind if kind in ("las", "laz", "e57") else "pcd"
    path = tmp_path / f"a.{suffix}"
    if suffix == "pcd":
        encoding = "binary_compressed" if kind == "packed" else kind
        cloud = pypcd4.pypcd4.PointCloud.from_xyz_points(CLOUD.astype(np.float32))
        cloud.save(path, encoding=pypcd4.pypcd4.Encoding(encoding))
    elif suffix == "e57":
        _write_e57(path, ["a"], (0.6, 0, 0.8, 0))
    else:
        _write_las(path, FAR)
    (scan,) = read_named(path, max_points=20).values()
    assert scan.step == 3
    np.testing.assert_array_equal(scan.points, read_points(path)[::3])


@pytest.mark.parametrize("kind", ["obj", "stl", "stl_ascii"])
def test_of_large_meshes_some_vertices_are_kept(tmp_path: Path, kind: str):
    ball = trimesh.creation.icosphere(2, 2.0)
    ball.faces = np.random.default_rng(0).permutation(ball.faces)
    path = tmp_path / f"a.{kind[:3]}"
    ball.export(path, file_type=kind)
    (scan,) = read_named(path, max_points=60).values()
    assert len(scan.points) <= 60
    assert len(scan.points) >= 0.5 * 60
    corners = {row.tobytes() for row in read_points(path)}
    assert {row.tobytes() for row in scan.points} <= corners


def test_points_that_the_scanner_marked_as_invalid_are_left_out(tmp_path: Path):
    data = {f"cartesian{a}": x.copy() for a, x in zip("XYZ", CLOUD.T, strict=True)}
    marked = np.arange(len(CLOUD)) % 4 == 1
    data["cartesianInvalidState"] = marked.astype(np.int8)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(data)
    points = read_points(tmp_path / "a.e57")
    np.testing.assert_array_equal(points, CLOUD[~marked])


@pytest.mark.parametrize("suffix", ["las", "laz", "e57"])
def test_files_that_were_cut_off_are_refused(tmp_path: Path, suffix: str):
    whole, cut = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    if suffix == "e57":
        _write_e57(whole, ["a"])
    else:
        _write_las(whole, FAR)
    size = 34 if suffix == "las" else 40  # 34 bytes are one point of this LAS format
    cut.write_bytes(whole.read_bytes()[:-size])
    with pytest.raises(InputError, match=r"b\.\w+: not a complete"):
        read_points(cut)


@pytest.mark.parametrize(
    ("content", "suffix", "said"),
    [
        (b"ply\nformat ascii 1.0\n", "pcd", "a PLY file .*\n.* to end in .ply"),
        (PCD.encode(), "ply", "a PCD file .*\n.* to end in .pcd"),
        (PCD.encode(), "xyz", "a PCD file .*\n.* to end in .pcd"),
        (b"LASF" + bytes(400), "e57", "a LAS file .*\n.* to end in .las"),
        (b"ASTM-E57" + bytes(40), "npz", "an E57 file .*\n.* to end in .e57"),
        (b"PK\x03\x04" + bytes(40), "stl", "an? NPZ or ZIP file"),
        (
            gzip.compress(b"1 2 3\n", mtime=0),
            "xyz",
            "a gzip file .*\n.* to end in .xyz.gz",
        ),
        (
            gzip.compress(b"ply\n", mtime=0),
            "pcd.gz",
            "a PLY file .*\n.* to end in .ply.gz",
        ),
    ],
)
def test_a_suffix_that_lies(tmp_path: Path, content: bytes, suffix: str, said: str):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_points(path)


@pytest.mark.parametrize(
    ("name", "package"),
    [("a.pcd", "pypcd4"), ("a.las", "laspy"), ("a.e57", "pye57")],
)
def test_a_missing_reader_names_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
):
    def missing(wanted: str) -> None:
        raise ModuleNotFoundError(f"No module named {wanted!r}", name=wanted)

    starts = {"a.las": b"LASF", "a.e57": b"ASTM-E57", "a.pcd": PCD.encode()}
    (tmp_path / name).write_bytes(starts[name])
    monkeypatch.setattr(importlib, "import_module", missing)
    said = rf"{package}, which is not installed\.\n.*jaxreg\[formats\]"
    with pytest.raises(MissingExtraError, match=said):
        read_points(tmp_path / name)


def test_readers_are_imported_only_when_needed():
    code = "import jaxreg.io, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0
    assert not {"laspy", "pye57", "trimesh", "pypcd4"} & set(done.stdout.split())


def test_info_of_all_formats(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "a.pcd").write_text(PCD)
    (tmp_path / "b.obj").write_text(OBJ)
    _write_las(tmp_path / "c.las", FAR)
    _write_e57(tmp_path / "d.e57", ["hall", "attic"])
    assert main(["info", str(tmp_path), "--json"]) == 0
    pcd, obj, las, e57 = json.loads(capsys.readouterr().out)["files"]
    assert (pcd["scans"][0]["has_colors"], las["scans"][0]["has_colors"]) == (True,) * 2
    assert pcd["scans"][0]["non_finite"] == pytest.approx(1 / 3)
    assert obj["scans"][0]["num_points"] == 4
    assert "map coordinates" in las["scans"][0]["hint"]
    assert e57["kind"] == "archive of scans"
    assert e57["scans"][0]["fields"] == ["cartesianX", "cartesianY", "cartesianZ"]
