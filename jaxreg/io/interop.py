"""To and from the objects of Open3D, trimesh and GTSAM.

Clouds and meshes of Open3D and trimesh are taken wherever points are.
"""

from typing import Any

import numpy as np

from jaxreg._core.checks import as_host_numbers, held_points
from jaxreg.graph.pose_graph import PoseGraph, check_graph
from jaxreg.io.extras import require


def points_of(geometry: Any) -> np.ndarray:
    """The points of a cloud, or the vertices of a mesh, of Open3D or trimesh.

        >>> from jaxreg import io
        >>> io.points_of(io.to_trimesh([[0, 1, 2]]))
        array([[0., 1., 2.]])

    Args:
        geometry: an Open3D cloud or mesh, also of its tensor kind, or a trimesh one.

    Returns:
        `(n, 3)` array in the precision of the object.

    Raises:
        TypeError: if the object holds no points.
    """
    points = held_points(geometry)
    if points is not geometry:
        return points
    raise TypeError(
        "geometry: wanted a cloud or mesh of Open3D or trimesh, found "
        f"{type(geometry).__name__}."
    )


def to_open3d(points: Any, colors: Any = None) -> Any:
    """An `open3d.geometry.PointCloud`.

    Args:
        points: `(n, 3)`.
        colors: `(n, 3)` in [0, 1], or None.

    Raises:
        MissingExtraError: if open3d is not installed.
    """
    open3d = require("open3d", "Making Open3D's clouds", "bench")
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(_points(points))
    if colors is not None:
        colors = as_host_numbers(colors, "colors")
        if colors.shape != (len(cloud.points), 3):
            raise ValueError(
                f"colors: wanted shape ({len(cloud.points)}, 3), found {colors.shape}."
            )
        cloud.colors = open3d.utility.Vector3dVector(colors)
    return cloud


def _points(points: Any) -> np.ndarray:
    found = as_host_numbers(points, "points")
    if found.ndim != 2 or found.shape[1] != 3:
        raise ValueError(f"points: wanted shape (n, 3), found {found.shape}.")
    return found


def to_trimesh(points: Any, colors: Any = None) -> Any:
    """A `trimesh.PointCloud`.

    Args:
        points: `(n, 3)`.
        colors: `(n, 3)` uint8, or None.

    Raises:
        MissingExtraError: if trimesh is not installed.
    """
    trimesh = require("trimesh", "Making trimesh's clouds")
    return trimesh.PointCloud(_points(points), colors=colors)


def to_open3d_graph(graph: PoseGraph, T_world_i: Any) -> Any:
    """An `open3d.pipelines.registration.PoseGraph` of a 3D graph.

    Its edge (s, t) holds the motion of s into t, so that the edge (i, j) becomes
    (j, i). The weight of an edge becomes its confidence.

    Args:
        graph: the relative motions; without information they have that of the identity.
        T_world_i: `(v, 4, 4)` poses of the nodes.

    Raises:
        MissingExtraError: if open3d is not installed.
    """
    o3d = require("open3d", "Making Open3D's graphs", "bench").pipelines.registration
    if check_graph(graph, "graph").dim != 3:
        raise ValueError(f"graph: wanted 3D, found {graph.dim}D.")
    poses = as_host_numbers(T_world_i, "T_world_i")
    if poses.shape != (graph.num_poses, 4, 4):
        raise ValueError(
            f"T_world_i: wanted shape ({graph.num_poses}, 4, 4), found {poses.shape}."
        )
    out = o3d.PoseGraph()
    for T in poses:
        out.nodes.append(o3d.PoseGraphNode(T))
    info = np.tile(np.eye(6), (graph.num_edges, 1, 1))
    if graph.information is not None:
        # Open3D has the rotation first.
        info = np.roll(np.asarray(graph.information, np.float64), 3, axis=(1, 2))
    for e in np.flatnonzero(graph.mask):
        i, j = (int(k) for k in graph.edges[e])
        T = np.asarray(graph.T_i_j[e], np.float64)
        weight = float(graph.weight[e])
        edge = o3d.PoseGraphEdge(j, i, T, info[e], uncertain=i + 1 != j)
        edge.confidence = weight
        out.edges.append(edge)
    return out


def from_open3d_graph(graph: Any) -> tuple[PoseGraph, np.ndarray]:
    """The edges of an Open3D pose graph, and the poses `(v, 4, 4)` of its nodes."""
    edges = list(graph.edges)
    info = np.stack([np.asarray(e.information) for e in edges])
    out = PoseGraph.from_edges(
        [(e.target_node_id, e.source_node_id) for e in edges],
        np.stack([np.asarray(e.transformation) for e in edges]),
        num_poses=len(graph.nodes),
        weight=[e.confidence for e in edges],
        information=np.roll(info, 3, axis=(1, 2)),
    )
    return out, np.stack([np.asarray(node.pose) for node in graph.nodes])


def to_gtsam(T_world_i: Any) -> Any:
    """`gtsam.Values` that hold the poses under the keys 0, 1, ...

    Args:
        T_world_i: `(v, 3, 3)` for `Pose2`, `(v, 4, 4)` for `Pose3`.

    Raises:
        MissingExtraError: if gtsam is not installed.
    """
    gtsam = require("gtsam", "Making GTSAM's values", "bench")
    values = gtsam.Values()
    poses = as_host_numbers(T_world_i, "T_world_i")
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 3), (4, 4)):
        raise ValueError(
            f"T_world_i: wanted shape (v, 3, 3) or (v, 4, 4), found {poses.shape}."
        )
    for key, T in enumerate(poses):
        if len(T) == 4:
            values.insert(key, gtsam.Pose3(T))
        else:
            angle = float(np.arctan2(T[1, 0], T[0, 0]))
            values.insert(key, gtsam.Pose2(T[0, 2], T[1, 2], angle))
    return values


def from_gtsam(values: Any) -> tuple[np.ndarray, np.ndarray]:
    """The keys `(v,)` of `gtsam.Values` in order, and their poses `(v, d+1, d+1)`.

    Raises:
        TypeError: if a value is neither `Pose2` nor `Pose3`.
    """
    keys = np.array(sorted(values.keys()))
    poses = [_pose(values, int(key)).matrix() for key in keys]
    return keys, np.stack(poses)


def _pose(values: Any, key: int) -> Any:
    for read in (values.atPose3, values.atPose2):
        try:
            return read(key)
        except RuntimeError:
            continue
    raise TypeError(f"values: wanted poses, found another value at key {key}.")
