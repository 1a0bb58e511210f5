"""Fixed vertices and priors of g2o files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import io
from jaxreg.averaging import PoseGraphLM, average
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


UPPER = " ".join(map(str, np.eye(6)[np.triu_indices(6)] * 100))
SMALL = f"""
VERTEX_SE3:QUAT 7 1 2 3 0 0 0 1
VERTEX_SE3:QUAT 9 0 0 0 0 0 0 1
EDGE_SE3:QUAT 7 9 1 0 0 0 0 0 1 {UPPER}
EDGE_SE3:QUAT 9 12 1 0 0 0 0 0 1 {UPPER}
FIX 7 12
PARAMS_SE3OFFSET 3 0.5 0 0 0 0 0 1
"""
TURNED = f"0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}"
#: Of the position alone: x for itself, and with z.
NO_TURN = " ".join(map(str, [4, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, *[0] * 9]))


def read(tmp_path: Path, text: str) -> io.KnownOfGraph:
    path = tmp_path / "a.g2o"
    path.write_text(text)
    return io.read_g2o_known(path)


def test_fixed_vertices_have_their_poses(tmp_path: Path):
    known = read(tmp_path, SMALL)
    # Nothing is known of the pose of 12.
    assert [frame for frame, _ in known.fixed] == [0]
    np.testing.assert_allclose(known.fixed[0][1][:3, 3], [1, 2, 3])
    graph = io.read_g2o(tmp_path / "a.g2o")
    sol = average(graph, PoseGraphLM(), **known._asdict())
    np.testing.assert_allclose(
        sol.T_world_i[:, :3, 3], [[1, 2, 3], [2, 2, 3], [3, 2, 3]], atol=1e-5
    )


def test_a_prior_of_a_sensor_is_one_of_its_frame(tmp_path: Path):
    known = read(tmp_path, f"{SMALL}EDGE_SE3_PRIOR 9 3 1 1 0 {TURNED} {UPPER}\n")
    ((frame, T, information),) = known.priors
    assert frame == 1
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    np.testing.assert_allclose(T[:3, :3], turn, atol=1e-12)
    # The sensor sits half a length along x, which points along y in the world.
    np.testing.assert_allclose(T[:3, 3], [1, 0.5, 0], atol=1e-12)
    rng = np.random.default_rng(0)
    error = 1e-4 * rng.normal(size=6)
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(error[3:]).as_matrix()
    E[:3, 3] = error[:3]
    sensor = np.eye(4)
    sensor[0, 3] = 0.5
    at_sensor = np.linalg.inv(sensor) @ E @ sensor
    seen = np.r_[at_sensor[:3, 3], Rotation.from_matrix(at_sensor[:3, :3]).as_rotvec()]
    assert error @ information @ error == pytest.approx(100 * seen @ seen, rel=1e-3)


def test_positions_are_control_points(tmp_path: Path):
    place = "EDGE_SE3_XYZPRIOR 9 3 4 5 6 2 0 0 3 0 4\n"
    pose = f"EDGE_SE3_PRIOR 12 0 1 1 0 {TURNED} {NO_TURN}\n"
    known = read(tmp_path, SMALL + place + pose)
    assert not known.priors
    (i, p, q, W), (j, p_turned, q_turned, W_turned) = sorted(
        known.control, key=lambda row: row[0]
    )
    assert (i, j) == (1, 2)
    np.testing.assert_allclose(p, [0.5, 0, 0])
    np.testing.assert_allclose(q, [4, 5, 6])
    np.testing.assert_allclose(W, np.diag([2.0, 3, 4]))
    np.testing.assert_allclose(p_turned, 0)
    np.testing.assert_allclose(q_turned, [1, 1, 0])
    # What was x of the frame is y of the world.
    turned = [[1, 0, 0], [0, 4, 1], [0, 1, 1]]
    np.testing.assert_allclose(W_turned, turned, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_what_is_written_is_read_again(tmp_path: Path, d: int):
    X, edges, T_i_j, _ = random_graph(7, 14, 0.0, 1, d=d)
    rng = np.random.default_rng(0)
    k = 6 if d == 3 else 3
    W = np.eye(k) + np.diag(np.arange(k)) + 0.2 / np.add.outer(np.arange(k), [1] * k)
    W = W + W.T
    place = np.zeros(2) if d == 2 else rng.normal(size=3)
    known = io.KnownOfGraph(
        priors=[(2, X[2], W)],
        fixed=[(0, X[0]), (5, X[5])],
        control=[(4, place, rng.normal(size=d), W[:d, :d])],
    )
    written = PoseGraph.from_edges(edges, T_i_j)
    ids = np.arange(7) * 10 + 3
    io.write_g2o(tmp_path / "a.g2o", written, X, ids=ids, known=known)
    assert io.read_g2o(tmp_path / "a.g2o").num_edges == 14
    again = io.read_g2o_known(tmp_path / "a.g2o")
    for rows, wanted in zip(again, known, strict=True):
        assert len(rows) == len(wanted)
        for row, other in zip(rows, wanted, strict=True):
            for x, y in zip(row, other, strict=True):
                np.testing.assert_allclose(x, y, atol=1e-6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            f"EDGE_SE3_PRIOR 8 3 1 1 0 {TURNED} {UPPER}",
            "no vertex or edge of 8",
        ),
        (f"EDGE_SE3_PRIOR 9 4 1 1 0 {TURNED} {UPPER}", "line 8: no PARAMS_SE3OFFSET 4"),
        ("EDGE_SE3_XYZPRIOR 9 3 4 5", "line 8: EDGE_SE3_XYZPRIOR wants 11 numbers"),
        ("FIX 7 x", "line 8: 'x' is no id"),
    ],
)
def test_lines_without_sense_are_named(tmp_path: Path, line: str, message: str):
    with pytest.raises(io.InputError, match=message):
        read(tmp_path, f"{SMALL}{line}\n")
