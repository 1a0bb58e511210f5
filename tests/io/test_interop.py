"""Objects of other libraries; those that are not installed are skipped."""

import numpy as np
import pytest
import trimesh
from helpers import motion

import jaxreg
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
