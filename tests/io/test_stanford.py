from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxreg.io import InputError, read_conf, read_scans
from tests.helpers import data_dir


def test_conjugate_quaternion_and_other_lines(tmp_path: Path):
    xyzw = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_quat()
    path = tmp_path / "a.conf"
    path.write_text(
        "camera 0 0 1 0 0 0 1\n"
        "mesh a_cybcyl 9 9 9 0 0 0 1\n"
        f"bmesh front.ply 1 2 3 {' '.join(map(str, 2 * xyzw))}\n"
        "bmesh back.ply 0 0 0 0 0 0 1\n"
    )
    poses = read_conf(path)
    assert list(poses) == ["front", "back"]
    expected = Rotation.from_quat(xyzw * [-1, -1, -1, 1]).as_matrix()
    np.testing.assert_allclose(poses["front"][:3, :3], expected, atol=1e-15)
    np.testing.assert_array_equal(poses["front"][:, 3], [1, 2, 3, 1])
    np.testing.assert_array_equal(poses["back"], np.eye(4))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("camera 0 0 1 0 0 0 1\n", "holds no line"),
        ("bmesh a.ply 1 2 3 0 0 1\n", "line 1: wanted seven numbers"),
        ("bmesh a.ply 1 2 3 0 0 0 one\n", "line 1: wanted seven numbers"),
    ],
)
def test_bad_pose_files(tmp_path: Path, content: str, message: str):
    path = tmp_path / "a.conf"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_conf(path)
    with pytest.raises(InputError, match=r"none\.conf: no such file"):
        read_conf(tmp_path / "none.conf")


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "stem"),
    [("stanford_bunny", "bun"), ("stanford_dragon", "dragonStandRight")],
)
def test_posed_scans_overlap(folder: str, stem: str):
    """The data's own table of overlaps is met only by the right reading."""
    file = "bunny_scans.npz" if stem == "bun" else f"{stem}_scans.npz"
    names, scans = read_scans(data_dir(folder, file))
    poses = read_conf(data_dir(folder, f"{stem}.conf"))
    assert set(names) <= set(poses)
    table = data_dir(folder, "overlap_1mm.csv").read_text().splitlines()
    columns = table[0].split(",")[1:]
    rows = {r.split(",")[0]: list(map(float, r.split(",")[1:])) for r in table[1:]}
    posed = [
        x[::20] @ poses[k][:3, :3].T + poses[k][:3, 3]
        for k, x in zip(names, scans, strict=True)
    ]
    a = 0
    for b in (1, 2, len(names) - 1):
        full = scans[b] @ poses[names[b]][:3, :3].T + poses[names[b]][:3, 3]
        near = KDTree(full).query(posed[a])[0] < 1e-3
        assert abs(near.mean() - rows[names[a]][columns.index(names[b])]) < 0.03
