"""Objects of other libraries; those that are not installed are skipped."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import blob, motion, move

import jaxreg
import jaxreg.app.views
from jaxreg import io


POINTS = np.random.default_rng(0).normal(size=(20, 3))


def test_trimesh_there_and_back():
    cloud = io.to_trimesh(POINTS, colors=np.full((20, 3), 200, np.uint8))
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(io.points_of(cloud), POINTS)
    assert io.points_of(trimesh.creation.box()).shape == (8, 3)
    with pytest.raises(TypeError, match=r"geometry: wanted .* found dict"):
        io.points_of({})


def test_open3d_clouds_there_and_back():
    open3d = pytest.importorskip("open3d")
    cloud = io.to_open3d(POINTS, colors=np.full((20, 3), 0.5))
    assert cloud.has_colors()
    np.testing.assert_array_equal(io.points_of(cloud), POINTS)
    tensor = open3d.t.geometry.PointCloud(POINTS.astype(np.float32))
    np.testing.assert_array_equal(io.points_of(tensor), POINTS.astype(np.float32))


@pytest.mark.parametrize("library", ["trimesh", "open3d"])
def test_clouds_are_taken_wherever_points_are(library: str, tmp_path: Path):
    pytest.importorskip(library)
    make = io.to_open3d if library == "open3d" else io.to_trimesh
    target = blob(200, 3)
    T = motion(1, 3, angle=0.1, shift=0.02)
    source = move(np.linalg.inv(T), target)
    clouds = make(source), make(target)
    method = jaxreg.ICP(jaxreg.PointToPoint(), jaxreg.robust.L2(), jaxreg.ClosedForm())
    sol = jaxreg.register(*clouds, method, init=np.eye(4))
    np.testing.assert_allclose(sol.T_target_source, T, atol=1e-4)
    pair = [clouds[0]], [clouds[1]]
    (one,) = jaxreg.register(*pair, method, init=[np.eye(4)])
    np.testing.assert_allclose(one.T_target_source, T, atol=1e-4)
    # Far away, too: in float64, as theirs are.
    far = source.astype(np.float64) + 1e4
    (one,) = jaxreg.register([make(far)], [clouds[1]], method, init=[_back(1e4)])
    np.testing.assert_allclose(
        move(np.asarray(one.T_target_source), far), target, atol=1e-3
    )
    io.write_points(tmp_path / "a.ply", clouds[0])
    np.testing.assert_allclose(io.read_points(tmp_path / "a.ply"), source, atol=1e-6)
    assert jaxreg.app.views.draw(sol, *clouds) is not None
    with pytest.raises(ValueError, match=r"target\[0\]: wanted shape"):
        jaxreg.register([target], [np.zeros((4, 4))], jaxreg.ICP())


def _back(offset: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = -offset
    return T


def _graph() -> tuple[jaxreg.PoseGraph, np.ndarray]:
    T = np.stack([motion(k, 3) for k in range(4)]).astype(np.float32)
    edges = np.array([(0, 1), (1, 2), (2, 3), (0, 3)])
    T_i_j = np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    info = np.diag(np.arange(1.0, 7)) + np.zeros((4, 1, 1))
    weight = [1.0, 0.5, 1.0, 0.25]
    return jaxreg.PoseGraph.from_edges(edges, T_i_j, weight=weight, information=info), T


def test_open3d_graphs_have_their_edges_the_other_way_round():
    pytest.importorskip("open3d")
    graph, T = _graph()
    theirs = io.to_open3d_graph(graph, T)
    edge = theirs.edges[3]
    assert (edge.source_node_id, edge.target_node_id) == (3, 0)
    # Theirs says that the target's pose times the motion is the source's.
    expected = theirs.nodes[0].pose @ edge.transformation
    np.testing.assert_allclose(expected, theirs.nodes[3].pose, atol=1e-5)
    # Rotation first.
    np.testing.assert_allclose(np.diag(edge.information), [4, 5, 6, 1, 2, 3])
    back, poses = io.from_open3d_graph(theirs)
    for name in ("edges", "T_i_j", "weight", "information"):
        one, other = getattr(back, name), getattr(graph, name)
        np.testing.assert_allclose(one, other, atol=1e-6)
    np.testing.assert_allclose(poses, T, atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_gtsam_values_there_and_back(d: int):
    gtsam = pytest.importorskip("gtsam")
    T = np.stack([motion(k, d) for k in range(5)])
    values = io.to_gtsam(T)
    keys, back = io.from_gtsam(values)
    np.testing.assert_array_equal(keys, np.arange(5))
    np.testing.assert_allclose(back, T, atol=1e-7)
    values.insert(7, gtsam.Point3(0, 0, 0))
    with pytest.raises(TypeError, match="at key 7"):
        io.from_gtsam(values)
