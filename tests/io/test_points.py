import gzip
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxreg.io import InputError, read_points, read_scans, write_ply
from jaxreg.io.points.read import read_named
from jaxreg.io.points.text import parse_text
from tests.helpers import data_dir


CLOUD = np.random.default_rng(0).normal(size=(20, 3))


def _gzip(path: Path) -> Path:
    packed = path.with_name(path.name + ".gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    return packed


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("d", [2, 3])
def test_npy_and_npz_round_trip(tmp_path: Path, dtype: type, d: int):
    points = CLOUD[:, :d].astype(dtype)
    np.save(tmp_path / "a.npy", points)
    np.savez(tmp_path / "b.npz", one=points, two=points[:7])
    one = read_points(tmp_path / "a.npy")
    two = read_points(f"{tmp_path}/b.npz:two")
    assert one.dtype == dtype
    np.testing.assert_array_equal(one, points)
    np.testing.assert_array_equal(two, points[:7])


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ply_round_trip(tmp_path: Path, dtype: type, binary: bool):
    path = tmp_path / "a.ply"
    points = CLOUD.astype(dtype)
    colors = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)
    write_ply(path, points, colors, binary=binary)
    for file in (path, _gzip(path)):
        back = read_points(file)
        assert back.dtype == dtype
        np.testing.assert_array_equal(back, points)
    vertex = plyfile.PlyData.read(path)["vertex"]
    np.testing.assert_array_equal(vertex["green"], colors[:, 1])


def test_ply_big_endian_without_z_and_with_other_elements(tmp_path: Path):
    vertex = np.zeros(5, dtype=[("quality", "u1"), ("x", "f4"), ("y", "f4")])
    vertex["x"] = np.arange(5)
    face = np.zeros(1, dtype=[("vertex_indices", "O")])
    face["vertex_indices"][0] = np.array([0, 1, 2], dtype=np.int32)
    elements = [
        plyfile.PlyElement.describe(face, "face"),
        plyfile.PlyElement.describe(vertex, "vertex"),
    ]
    plyfile.PlyData(elements, byte_order=">").write(tmp_path / "a.ply")
    points = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, np.stack([np.arange(5), np.zeros(5)], 1))


TEXTS = {
    "plain": "1 2 3\n4 5 6\n",
    "tabs, header, windows": "x\ty\tz\r\n1\t2\t3\r\n4\t5\t6\r\n",
    "commas and more columns": "x,y,z,nx,label\n1,2,3,0.5,a\n4,5,6,0.5,b\n",
    "semicolons, decimal commas": "1,0;2,0;3,0\n4,0;5,0;6,0\n",
    "comments and blank lines": "# made by hand\n\n1 2 3\n\n// more\n4 5 6",
    "a count before the points": "2\n1 2 3\n4 5 6\n",
    "a name before the numbers": "p 1 2 3\nq 4 5 6\n",
    "byte order mark": "\ufeff1 2 3\n4 5 6\n",
    "spaces around commas": " 1 , 2, 3\n 4 , 5, 6 \n",
}


@pytest.mark.parametrize("kind", list(TEXTS))
def test_dialects_of_text(tmp_path: Path, kind: str):
    path = tmp_path / "a.xyz"
    path.write_bytes(TEXTS[kind].encode())
    for file in (path, _gzip(path)):
        np.testing.assert_array_equal(read_points(file), [[1, 2, 3], [4, 5, 6]])


def test_two_columns_are_2d_and_empty_cells_are_nan():
    lines = enumerate(["x,y", "1,2", "3,", "nan,inf"], start=1)
    two, names = parse_text(lines, Path("a.csv"))
    assert names == ("x", "y")
    np.testing.assert_array_equal(two, [[1, 2], [3, np.nan], [np.nan, np.inf]])


def test_text_keeps_what_float32_would_lose(tmp_path: Path):
    path = tmp_path / "utm.txt"
    path.write_text("466123.4567 5427001.2345 112.001\n" * 4)
    assert read_points(path)[0].tolist() == [466123.4567, 5427001.2345, 112.001]


@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 6), st.sampled_from([2, 3])),
        elements=st.floats(allow_nan=False, width=64),
    ),
    st.sampled_from([" ", "\t", ",", ";"]),
)
def test_text_is_exact(points: np.ndarray, separator: str):
    rows = [separator.join(map(repr, row)) for row in points.tolist()]
    back, _ = parse_text(enumerate(rows), Path("a.txt"))
    np.testing.assert_array_equal(back, points)


def test_folder_archive_and_files_in_natural_order(tmp_path: Path):
    for k in (10, 2, 1):
        np.save(tmp_path / f"scan{k}.npy", CLOUD * k)
    (tmp_path / "notes.md").write_text("not a scan")
    (tmp_path / ".hidden.npy").write_text("not a scan")
    names, scans = read_scans(tmp_path)
    assert names == ["scan1", "scan2", "scan10"]
    np.testing.assert_array_equal(scans[2], CLOUD * 10)
    np.savez(tmp_path / "all.npz", front=CLOUD, scan1=CLOUD)
    names, scans = read_scans([tmp_path / "all.npz", str(tmp_path / "scan1.npy")])
    assert names == ["front", "scan1", "scan1-2"]
    names, _ = read_scans([f"{tmp_path}/all.npz:front", tmp_path / "scan2.npy"])
    assert names == ["front", "scan2"]


def test_a_readme_among_scans_is_skipped_with_a_note(tmp_path: Path):
    np.save(tmp_path / "a.npy", CLOUD)
    (tmp_path / "b.xyz").write_text("x y z\n1 2 3\n")
    (tmp_path / "readme.txt").write_text("Scans of 2024\n\nmade by hand, 3 in all\n")
    with pytest.warns(UserWarning, match=r"readme\.txt: holds no points, skipped"):
        names, _ = read_scans(tmp_path)
    assert names == ["a", "b"]


@pytest.mark.parametrize(
    "other",
    [
        "",
        "Scans of 2024\nresolution\n0.5 0.5\nmade by hand\n",
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n",
        "0 1 2 3 0 0 0 1\n1 1 2 4 0 0 0 1\n",
        "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 2 0 0 1 3\n",
    ],
)
def test_other_text_among_scans_does_not_stop_them(tmp_path: Path, other: str):
    np.save(tmp_path / "a.npy", CLOUD)
    (tmp_path / "notes.txt").write_text(other)
    with pytest.warns(UserWarning, match=r"notes\.txt: holds no points, skipped"):
        names, _ = read_scans(tmp_path)
    assert names == ["a"]


def test_a_scan_that_was_not_exported_stops_a_folder(tmp_path: Path):
    np.save(tmp_path / "a.npy", CLOUD)
    (tmp_path / "b.xyz").write_text("")
    with pytest.raises(InputError, match=r"b\.xyz: the file is empty"):
        read_scans(tmp_path)


def _write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


PLY_HEAD = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
)
BAD = {
    "empty": ("a.xyz", b""),
    "empty.gz": ("a.xyz.gz", gzip.compress(b"")),
    "only a header": ("a.csv", b"x,y,z\n"),
    "prose": ("a.txt", b"These are\nno points\nat all\n"),
    "ragged": ("a.txt", b"1 2 3\n4 5\n"),
    "word in a row": ("a.txt", b"1 2 3\n4 five 6\n"),
    "binary as text": ("a.txt", bytes(range(256))),
    "not gzip": ("a.xyz.gz", b"1 2 3\n"),
    "cut gzip": ("a.xyz.gz", gzip.compress(b"1 2 3\n" * 99)[:-12]),
    "not ply": ("a.ply", b"1 2 3\n"),
    "cut ply": ("a.ply", PLY_HEAD + b"property float z\nend_header\n1 2 3\n4 5 6\n"),
    "ply without y": ("a.ply", PLY_HEAD.replace(b" y", b" q") + b"end_header\n"),
    "ply of no vertices": ("a.ply", PLY_HEAD.replace(b"3", b"0") + b"end_header\n"),
    "not npy": ("a.npy", b"1 2 3\n"),
    "not npz": ("a.npz", b"1 2 3\n"),
    "unknown suffix": ("a.doc", b"1 2 3\n"),
    "no suffix": ("a", b"1 2 3\n"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_files_are_named_in_two_lines(tmp_path: Path, kind: str):
    path = _write(tmp_path / BAD[kind][0], BAD[kind][1])
    with pytest.raises(InputError) as caught:
        read_points(path)
    lines = str(caught.value).splitlines()
    assert str(path) in lines[0]
    assert len(lines) <= 2


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 3)),
        np.zeros((4, 4)),
        np.zeros(6),
        np.zeros((4, 3), dtype=complex),
        np.array([["a", "b"]]),
    ],
)
def test_bad_arrays_are_named(tmp_path: Path, array: np.ndarray):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "b.npz", bad=array)
    np.savez(tmp_path / "c.npz", good=CLOUD, bad=array)
    with pytest.raises(InputError, match=r"a\.npy"):
        read_points(tmp_path / "a.npy")
    with pytest.raises(InputError, match=r"b\.npz:bad"):
        read_scans(tmp_path / "b.npz")
    with pytest.raises(InputError, match=r"c\.npz:bad"):
        read_points(f"{tmp_path}/c.npz:bad")
    np.testing.assert_array_equal(read_points(f"{tmp_path}/c.npz:good"), CLOUD)


def test_arrays_beside_the_scans_are_skipped_with_a_note(tmp_path: Path):
    others = {"T_world_i": np.eye(4)[None], "unit": "m", "voxel": 0.1}
    np.savez(tmp_path / "a.npz", one=CLOUD, **others)
    with pytest.warns(UserWarning, match="skipped: T_world_i, unit, voxel"):
        names, _ = read_scans(tmp_path / "a.npz")
    assert names == ["one"]
    np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), CLOUD)


def test_pickles_are_refused(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="plain numbers"):
        read_points(tmp_path / "a.npy")


def test_missing_file_folder_without_points_and_unnamed_scan(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path / "none.ply")
    with pytest.raises(InputError, match="no such file"):
        read_scans(tmp_path / "folder")
    (tmp_path / "sub").mkdir()
    with pytest.raises(InputError, match="no point files"):
        read_scans(tmp_path / "sub")
    np.savez(tmp_path / "two.npz", front=CLOUD, back=CLOUD)
    with pytest.raises(InputError, match="holds 2 scans: front, back"):
        read_points(tmp_path / "two.npz")
    with pytest.raises(InputError, match="has no scan side"):
        read_points(f"{tmp_path}/two.npz:side")


@pytest.mark.parametrize(
    "suffix", [".ply", ".npy", ".npz", ".xyz", ".xyz.gz", ".ply.gz"]
)
def test_of_large_scans_every_so_many_points_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
):
    monkeypatch.setattr("jaxreg.io.points.thinning._MOST_TEXT", 8_000)
    monkeypatch.setattr("jaxreg.io.points.thinning._ROWS", 170)
    points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    path = tmp_path / f"scan{suffix}"
    if suffix == ".npy":
        np.save(path, points)
    elif suffix == ".npz":
        np.savez_compressed(path, rows=points, columns=np.asfortranarray(points))
        rows, columns = read_named(path, max_points=300).values()
        np.testing.assert_array_equal(rows.points, points[::4])
        np.testing.assert_array_equal(columns.points, points[::4])
        path = Path(f"{path}:columns")
    elif suffix in (".xyz", ".xyz.gz"):
        np.savetxt(path, points)
    else:
        write_ply(tmp_path / "scan.ply", points)
        packed = gzip.compress((tmp_path / "scan.ply").read_bytes())
        (tmp_path / "scan.ply.gz").write_bytes(packed)
    (scan,) = read_named(path, max_points=300).values()
    assert scan.step >= 4
    assert 1000 / scan.step - 1 <= len(scan.points) <= 300
    kept = {row.tobytes() for row in points}
    assert all(x.astype(np.float32).tobytes() in kept for x in scan.points)
    (whole,) = read_named(path, max_points=2000).values()
    assert whole.step == (1 if ".xyz" not in suffix else whole.step)


def test_write_ply_refuses_wrong_shapes(tmp_path: Path):
    with pytest.raises(ValueError, match="points"):
        write_ply(tmp_path / "a.ply", np.zeros((4, 4)))
    with pytest.raises(ValueError, match="colors"):
        write_ply(tmp_path / "a.ply", np.zeros((4, 3)), np.zeros((3, 3)))
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.data
def test_real_files_of_five_kinds():
    horse = read_points(data_dir("horse", "horse.ply.gz"))
    assert horse.shape == (48485, 3)
    moved = read_points(data_dir("horse", "horse_tr1.txt.gz"))
    assert moved.shape == horse.shape
    # The copies differ by a rigid motion: distances to the first vertex agree.
    gaps = [np.linalg.norm(x - x[0], axis=1)[:1000] for x in (horse, moved)]
    np.testing.assert_allclose(gaps[0], gaps[1], atol=2e-6)
    for file, num in (("car_cloud400.csv.gz", 24989), ("car_cloud401.csv.gz", 25193)):
        assert read_points(data_dir("car_lidar_pair", file)).shape == (num, 3)
    fish = read_points(data_dir("pointsets_2d", "gmmreg_fish_X.txt"))
    assert fish.shape == (98, 2)
    names, scans = read_scans(data_dir("stanford_bunny", "bunny_scans.npz"))
    assert (names[0], len(names), scans[0].shape[1]) == ("bun000", 10, 3)
