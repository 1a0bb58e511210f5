import gzip

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxreg as jr
from jaxreg.graph import PoseGraph
from jaxreg.graph.chordal import chordal_weights
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o import read_g2o, read_g2o_poses, write_g2o
from tests.helpers import data_dir


INFO3 = "1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6"
SMALL = f"""# three poses with odd names
VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 900 1 2 3 0 0 0.7071067811865476 0.7071067811865476
FIX 7
VERTEX_SE3:QUAT 30 0 1 0 0 0 0 2
EDGE_SE3:QUAT 7 900 1 2 3 0 0 0.7071067811865476 0.7071067811865476 {INFO3}
EDGE_SE3:QUAT 900 30 0 0 1 0.5 0.5 0.5 0.5 {INFO3}
"""


def random_graph(d: int, num: int = 6) -> tuple[PoseGraph, np.ndarray]:
    rng = np.random.default_rng(d)
    T = np.tile(np.eye(d + 1), (2 * num, 1, 1))
    R3 = Rotation.from_quat(rng.normal(size=(2 * num, 4))).as_matrix()
    angle = rng.uniform(-np.pi, np.pi, 2 * num)
    R2 = np.moveaxis(
        np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]),
        -1,
        0,
    )
    T[:, :d, :d] = R3 if d == 3 else R2
    T[:, :d, d] = rng.normal(size=(2 * num, d))
    k = 6 if d == 3 else 3
    half = rng.normal(size=(num, k, k)).astype(np.float32)
    edges = np.stack([np.arange(num), (np.arange(num) + 1) % num], axis=1)
    graph = PoseGraph.from_edges(
        edges, T[:num].astype(np.float32), information=half @ half.swapaxes(1, 2)
    )
    return graph, T[num:].astype(np.float32)


def test_ids_conventions_and_vertices(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text(SMALL)
    graph = read_g2o(path)
    assert graph.num_poses == 3
    np.testing.assert_array_equal(graph.edges, [[0, 2], [2, 1]])
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    np.testing.assert_allclose(graph.T_i_j[0, :3, :3], quarter, atol=1e-6)
    np.testing.assert_allclose(graph.T_i_j[0, :3, 3], [1, 2, 3])
    assert graph.information is not None
    np.testing.assert_allclose(graph.information[0], np.diag(range(1, 7)))
    ids, poses = read_g2o_poses(path)
    np.testing.assert_array_equal(ids, [7, 30, 900])
    assert poses is not None
    np.testing.assert_allclose(
        poses[1], [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("suffix", [".g2o", ".g2o.gz"])
def test_what_is_written_is_read_again(tmp_path, d, suffix):
    graph, poses = random_graph(d)
    path = tmp_path / f"a{suffix}"
    names = np.array([5, 8, 100, 101, 4000, 123456789012])
    write_g2o(path, graph, jnp.asarray(poses), ids=names)
    again = read_g2o(path)
    ids, T = read_g2o_poses(path)
    np.testing.assert_array_equal(ids, names)
    np.testing.assert_array_equal(again.edges, graph.edges)
    np.testing.assert_allclose(again.T_i_j, graph.T_i_j, atol=1e-6)
    assert again.information is not None
    assert graph.information is not None
    assert T is not None
    np.testing.assert_allclose(again.information, graph.information, rtol=1e-6)
    np.testing.assert_allclose(T, poses, atol=1e-6)


def test_double_precision_survives_writing(tmp_path):
    with jax.enable_x64(True):
        graph, poses = random_graph(3)
        graph = PoseGraph.from_edges(
            graph.edges, np.asarray(graph.T_i_j, np.float64), weight=np.full(6, 2.0)
        ).padded(9)
        write_g2o(tmp_path / "a.g2o", graph)
        again = read_g2o(tmp_path / "a.g2o")
        assert again.T_i_j.dtype == jnp.float64
        assert again.num_edges == 6
        np.testing.assert_allclose(again.T_i_j, graph.T_i_j[:6], atol=1e-15)
        assert again.information is not None
        np.testing.assert_allclose(again.information[0], 2 * np.eye(6))
        assert read_g2o_poses(tmp_path / "a.g2o")[1] is None


def test_unknown_lines_are_counted_and_warned_of(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text("TAG 1\nTAG 2\n" + SMALL)
    with pytest.warns(UserWarning, match="kinds .2 x TAG"):
        assert read_g2o(path).num_edges == 2


def test_of_indefinite_information_the_nearest_is_taken(tmp_path):
    path = tmp_path / "a.g2o"
    good = "EDGE_SE2 0 1 1 0 0 4 1 0 3 0 2\n"
    path.write_text(good + "EDGE_SE2 1 2 1 0 0 2 3 0 2 0 5\n" + good)
    with pytest.warns(UserWarning, match="1 of 3 edges have an indefinite"):
        graph = read_g2o(path)
    assert graph.information is not None
    expected = [[[4, 1, 0], [1, 3, 0], [0, 0, 2]], [[2.5, 2.5, 0], [2.5, 2.5, 0]]]
    np.testing.assert_array_equal(graph.information[0], expected[0])
    np.testing.assert_allclose(graph.information[1, :2], expected[1], atol=1e-5)
    np.testing.assert_allclose(graph.information[1, 2], [0, 0, 5], atol=1e-6)
    kappa, tau = chordal_weights(graph)
    assert np.isfinite(kappa).all()
    assert np.asarray(tau)[1] > 0


def test_a_coupling_too_large_leaves_the_precisions_of_se_sync(tmp_path):
    rng = np.random.default_rng(0)
    half = 100 * rng.normal(size=(4, 6, 6))
    info = half @ half.swapaxes(1, 2)
    info[1:, :3, 3:] *= 4
    info[1:, 3:, :3] *= 4
    assert (np.linalg.eigvalsh(info)[1:, 0] < -1e3).all()
    ends = [(0, 1), (1, 2), (2, 3), (0, 3)]
    text = "".join(
        f"EDGE_SE3:QUAT {i} {j} {j - i} {0.01 * j} 0 0.01 0 {0.01 * j} 1 "
        + " ".join(f"{x:.17g}" for x in matrix[np.triu_indices(6)])
        + "\n"
        for (i, j), matrix in zip(ends, info, strict=True)
    )
    path = tmp_path / "a.g2o"
    path.write_text(text)
    with jax.enable_x64(True):
        with pytest.warns(UserWarning, match="3 of 4 edges have an indefinite"):
            graph = read_g2o(path)
        kappa, tau = chordal_weights(graph)
        assert graph.information is not None
        # As SE-Sync's reader has them, of the numbers that the file holds.
        inverse = np.linalg.inv(info[:, :3, :3]), np.linalg.inv(info[:, 3:, 3:])
        traces = np.trace(inverse, axis1=-2, axis2=-1)
        np.testing.assert_allclose(tau, 3 / traces[0], rtol=1e-9)
        np.testing.assert_allclose(kappa, 1.5 / traces[1], rtol=1e-9)
        found = np.asarray(graph.information)
        np.testing.assert_array_equal(found[0], info[0])
        assert (np.linalg.eigvalsh(found)[:, 0] > 0).all()
        # No more is taken from the coupling than has to be.
        assert (np.linalg.eigvalsh(found)[1:, 0] < 1).all()
        sol = jr.average(graph, jr.PoseGraphLM(jr.ChordalError()))
        assert jr.Status(int(sol.status)) == jr.Status.CONVERGED
        R, t = np.asarray(sol.T_world_i)[:, :3, :3], np.asarray(sol.T_world_i)[:, :3, 3]
        T = np.asarray(graph.T_i_j)
        i, j = np.array(ends).T
        turned = R[j] - R[i] @ T[:, :3, :3]
        moved = t[j] - t[i] - np.einsum("eij,ej->ei", R[i], T[:, :3, 3])
        F = np.sum(1.5 / traces[1] * np.sum(turned**2, (1, 2)))
        F += np.sum(3 / traces[0] * np.sum(moved**2, 1))
        found = jr.metrics.chordal_objective(graph, sol.T_world_i)
        np.testing.assert_allclose(found, F, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n",
            "line 1: EDGE_SE2 wants 11 numbers, found 10",
        ),
        ("\nEDGE_SE2 0 x 1 0 0 1 0 0 1 0 1\n", "line 2: 'x' is not an integer id"),
        ("EDGE_SE2 0 1 1 0 a 1 0 0 1 0 1\n", "line 1: 'a' is not a number"),
        ("EDGE_SE2 0 1 1 0 nan 1 0 0 1 0 1\n", "line 1: .* not finite"),
        ("FIX 0\nEDGE_SE2 4 4 1 0 0 1 0 0 1 0 1\n", "line 2: .*with itself"),
        ("EDGE_SE2 0 1 1 0 0 -1 0 0 -1 0 -1\n", "line 1: .*indefinite"),
        ("VERTEX_SE2 0 0 0 0\n", "holds no EDGE"),
        (
            f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 0 {INFO3}\n",
            "line 1: the quaternion is zero",
        ),
        (
            "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1",
            "2D and 3D",
        ),
        ("hello\n", "no pose graph"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*unknown kinds")
def test_errors_name_file_and_line(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(InputError, match=f"bad.g2o.*{message}"):
        read_g2o(path)


def test_missing_and_truncated_files_are_named(tmp_path):
    with pytest.raises(InputError, match="none.g2o: no such file"):
        read_g2o(tmp_path / "none.g2o")
    path = tmp_path / "cut.g2o.gz"
    path.write_bytes(gzip.compress(SMALL.encode())[:-20])
    with pytest.raises(InputError, match="cut.g2o.gz: cannot be read"):
        read_g2o(path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    graph, poses = random_graph(3)
    path = tmp_path / "a.g2o"
    path.write_text("old")
    with pytest.raises(ValueError, match="T_world_i: wanted shape"):
        write_g2o(path, graph, jnp.asarray(poses[:2]))
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.g2o"]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "poses", "edges", "has_vertices"),
    [
        ("tinyGrid3D", 9, 11, True),
        ("intel", 1728, 2512, True),
        ("CSAIL", 1045, 1172, False),
    ],
)
def test_public_files(name, poses, edges, has_vertices):
    path = data_dir("pose_graphs", f"{name}.g2o")
    graph = read_g2o(path)
    assert (graph.num_poses, graph.num_edges) == (poses, edges)
    assert (read_g2o_poses(path)[1] is not None) == has_vertices


def test_what_would_not_be_read_is_not_written(tmp_path):
    graph, _ = random_graph(3)
    negative = eqx.tree_at(lambda g: g.weight, graph, -graph.weight)
    with pytest.raises(ValueError, match=r"graph: edge 0 .*weight is negative"):
        write_g2o(tmp_path / "a.g2o", negative)
    assert not list(tmp_path.iterdir())
