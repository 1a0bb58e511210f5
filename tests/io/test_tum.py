import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.io.errors import InputError
from jaxreg.io.poses.tum import read_tum, write_tum
from jaxreg.io.quaternions import motions_from_xyzw, xyzw_from_rotations


def test_quaternions_there_and_back_also_at_half_turns():
    half = np.pi * np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.8, 0]]])
    R = Rotation.concatenate(
        [
            Rotation.from_quat(np.random.default_rng(0).normal(size=(50, 4))),
            Rotation.from_rotvec(half),
            Rotation.identity(1),
        ]
    )
    q = xyzw_from_rotations(R.as_matrix())
    back = motions_from_xyzw(np.zeros((len(q), 3)), 3 * q)
    np.testing.assert_allclose(back[:, :3, :3], R.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(np.abs(np.sum(q * R.as_quat(), axis=1)), 1, atol=1e-14)
    assert (q[:, 3] >= 0).all()
    lost = np.stack([np.full((3, 3), np.nan), np.eye(3)])
    np.testing.assert_array_equal(
        xyzw_from_rotations(lost), [[np.nan] * 4, [0, 0, 0, 1]]
    )


def test_round_trip_in_3d_and_2d(tmp_path):
    path = tmp_path / "a.txt"
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(
        np.random.default_rng(1).normal(size=(4, 4))
    ).as_matrix()
    T[:, :3, 3] = np.random.default_rng(0).normal(size=(4, 3))
    write_tum(path, np.float32(T), timestamps=np.arange(4) + 1305031102.1758)
    times, again = read_tum(path)
    np.testing.assert_array_equal(times, np.arange(4) + 1305031102.1758)
    np.testing.assert_allclose(again, T, atol=1e-6)
    flat = np.eye(3)[None].repeat(2, axis=0)
    flat[1] = [[0, -1, 5], [1, 0, 6], [0, 0, 1]]
    write_tum(path, flat)
    times, again = read_tum(path)
    np.testing.assert_array_equal(times, [0, 1])
    np.testing.assert_allclose(again[1, :2, :2], flat[1, :2, :2], atol=1e-6)
    np.testing.assert_allclose(again[1, :3, 3], [5, 6, 0])
    with open(path) as file:
        row = file.read().splitlines()[2].split()
    np.testing.assert_allclose([float(x) for x in row[4:]], [0, 0, 0.5**0.5, 0.5**0.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1: wanted 8 finite numbers"),
        ("# c\n0 0 0 0 0 0 0 x\n", "line 2: not numbers"),
        ("0 0 0 0 0 0 0 0\n", "line 1: the quaternion is zero"),
        ("0 0 0 nan 0 0 0 1\n", "line 1: wanted 8 finite"),
        ("# nothing\n", "holds no poses"),
    ],
)
def test_errors_name_the_line(tmp_path, text, message):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_tum(path)


def test_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="T_world_i: wanted shape"):
        write_tum(tmp_path / "a", np.eye(4))
    with pytest.raises(ValueError, match="timestamps: wanted shape"):
        write_tum(tmp_path / "a", np.eye(4)[None], np.zeros(2))
