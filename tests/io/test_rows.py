import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.graph import PoseGraph
from jaxreg.io import (
    InputError,
    read_info,
    read_kitti,
    read_log,
    read_toro,
    write_kitti,
    write_log,
)
from tests.helpers import data_dir


def motions(num: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(num, 4))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(num, 3))
    return T.astype(np.float32)


def test_kitti_round_trip(tmp_path):
    T = motions(4)
    write_kitti(tmp_path / "poses.txt", T)
    np.testing.assert_array_equal(read_kitti(tmp_path / "poses.txt"), T)
    first = (tmp_path / "poses.txt").read_text().split()[:4]
    np.testing.assert_array_equal(np.float32(first), T[0, 0])
    with pytest.raises(ValueError, match=r"T_world_i: wanted shape \(v, 4, 4\)"):
        write_kitti(tmp_path / "flat.txt", T[:, :3, :3])


def test_log_round_trip(tmp_path):
    T = motions(3)
    graph = PoseGraph.from_edges([[0, 2], [2, 1], [3, 0]], T, num_poses=5)
    write_log(tmp_path / "a.log", graph)
    again = read_log(tmp_path / "a.log")
    assert again.num_poses == 5
    np.testing.assert_array_equal(again.edges, graph.edges)
    np.testing.assert_allclose(again.T_i_j, graph.T_i_j, atol=1e-6)
    flat = PoseGraph.from_edges([[0, 1]], np.eye(3)[None])
    with pytest.raises(ValueError, match="graph: wanted 3D, found 2D"):
        write_log(tmp_path / "b.log", flat)


def test_toro_conventions(tmp_path):
    path = tmp_path / "a.graph"
    path.write_text(
        "VERTEX2 9 0 0 0\nEDGE2 9 40 1 2 0.5 1 0.2 30 6 0.4 0.5\nEQUIV 1 2\n"
    )
    graph = read_toro(path)
    np.testing.assert_array_equal(graph.edges, [[0, 1]])
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [[c, -s, 1], [s, c, 2], [0, 0, 1]]
    np.testing.assert_allclose(graph.T_i_j[0], expected, rtol=1e-6)
    assert graph.information is not None
    np.testing.assert_allclose(
        graph.information[0], [[1, 0.2, 0.4], [0.2, 30, 0.5], [0.4, 0.5, 6]]
    )
    upper = "1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6"
    path.write_text(f"EDGE3 0 1 1 2 3 0.1 -0.2 0.3 {upper}\n")
    graph = read_toro(path)
    R = Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix()
    np.testing.assert_allclose(graph.T_i_j[0, :3, :3], R, atol=1e-6)
    assert graph.information is not None
    np.testing.assert_array_equal(graph.information[0], np.diag(range(1, 7)))


EYE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_kitti, "", "holds no poses"),
        (read_kitti, "1 2 3\n", "line 1: a pose wants 12 numbers, found 3"),
        (read_kitti, "\n" + "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 2: .*reflection"),
        (read_kitti, "x " * 12, "line 1: not numbers alone"),
        (read_kitti, "nan " * 12, "line 1: .*not finite"),
        (read_log, "", "holds no pairs"),
        (read_log, "0 1\n", "line 1: a pair wants 3 numbers"),
        (read_log, "0 1 2\n1 0 0 0\n", "line 1: the file ends within this matrix"),
        (read_log, f"0 1 2\n{EYE}1 2 2\n{EYE}", "line 6: wanted i and j below n"),
        (read_log, f"0 -1 2\n{EYE}", "line 1: '-1' is not an integer id"),
        (read_log, f"0 1 2\n{EYE[:-2]}5\n", r"line 1: edge 0 \(0, 1\): the last row"),
        (read_log, f"1 1 2\n{EYE}", "line 1: .*joins a frame with itself"),
        (read_info, f"0 1 2\n{EYE}0 1\n2\n", "line 2: a row wants 6 numbers"),
        (read_toro, "VERTEX2 0 0 0 0\n", "no EDGE2 or EDGE3 line"),
        (read_toro, "EDGE2 0 1 1 2\n", "line 1: EDGE2 wants 11 numbers, found 4"),
        (read_toro, "EDGE4 0 1\n", "line 1: 'EDGE4' is no kind of line"),
        (
            read_toro,
            f"EDGE2 {'9' * 30} 1 1 2 3 1 0 1 1 0 0\n",
            "line 1: '9+' is not an integer id",
        ),
        (read_toro, "EDGE2 a 1 1 2 3 1 0 1 1 0 0\n", "line 1: not numbers alone"),
        (read_toro, "EDGE2 0 1 1 2 3 -1 0 1 1 0 0\n", "line 1: .*indefinite"),
    ],
)
def test_errors_name_the_line(tmp_path, read, text, message):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read(path)
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "absent")


@pytest.mark.data
def test_real_files():
    folder = data_dir("redwood_3dmatch_relative_poses", "iclnuim-office1")
    graph = read_log(folder / "gt.log")
    T, edges = np.asarray(graph.T_i_j, np.float64), np.asarray(graph.edges).tolist()
    at = {tuple(e): k for k, e in enumerate(edges)}
    i, j, k = next(
        (i, j, k) for i, j in edges for k in range(54) if (j, k) in at and (i, k) in at
    )
    closed = T[at[i, j]] @ T[at[j, k]] @ np.linalg.inv(T[at[i, k]])
    np.testing.assert_allclose(closed, np.eye(4), atol=5e-3)
    pairs, information = read_info(folder / "gt.info")
    np.testing.assert_array_equal(pairs, edges)
    np.testing.assert_allclose(information, information.swapaxes(1, 2), rtol=1e-6)
    sphere = read_toro(data_dir("pose_graphs", "sphere2500_groundtruth.txt"))
    assert (sphere.num_poses, sphere.num_edges) == (2500, 4949)
