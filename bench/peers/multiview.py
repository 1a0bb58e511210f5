"""Many scans by Open3D: RANSAC on features for every pair, then multiway optimisation.

As in Open3D's tutorials on global and on multiway registration: FPFH and RANSAC, ICP,
information matrices, a pose graph from the tree of highest scores, and global
optimisation with a line process that prunes edges. Then once more with the pairs that
overlap at the poses found, by ICP on finer clouds.
"""

import importlib
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from bench.peers.global_pairs import Features


class Multiway(NamedTuple):
    """Settings of a user who knows the spacing of the points.

    Attributes:
        voxel: side of the voxels that thin the clouds, five spacings.
        fine: that of the second round, two spacings.
        least: share of points that meet, below which a pair is left out.
        prune: confidence of the line process below which an edge is pruned.
        camera_at_origin: as in `Features`.
        crowd: where scans are noisy, how many points must lie within which distance of
            a point for it to stay.
    """

    voxel: float
    fine: float
    least: float = 0.3
    prune: float = 0.25
    camera_at_origin: bool = True
    crowd: tuple[int, float] | None = None

    def solve(self, scans: list[np.ndarray], seed: int) -> np.ndarray:
        """Poses `(v, 4, 4)` in the frame of scan 0; NaN for what is not joined."""
        if self.crowd is not None:
            scans = [_without_noise(scan, *self.crowd) for scan in scans]
        pair = Features("RANSAC", self.voxel, camera_at_origin=self.camera_at_origin)
        clouds = [pair.prepare(scan) for scan in scans]
        motions, scores = {}, np.zeros((len(scans),) * 2)
        for i, j in _pairs(len(scans)):
            T, score = pair.solve(clouds[j], clouds[i], seed)
            if score >= self.least:
                motions[i, j], scores[i, j] = T, score
        start = _tree(motions, scores)
        coarse = [cloud for cloud, _ in clouds]
        T_world_i = self._optimised(coarse, motions, start, 1.5 * self.voxel)
        return self._again(scans, T_world_i)

    def _again(self, scans: list[np.ndarray], T_world_i: np.ndarray) -> np.ndarray:
        """All that overlaps at the poses found, measured by ICP on finer clouds."""
        lib: Any = importlib.import_module("open3d")
        reg = lib.pipelines.registration
        clouds, reach = [self._fine(lib, scan) for scan in scans], 3 * self.fine
        plane, motions = reg.TransformationEstimationPointToPlane(), {}
        for i, j in _pairs(len(scans)):
            T = np.linalg.inv(T_world_i[i]) @ T_world_i[j]
            if np.isnan(T).any():
                continue
            there = reg.evaluate_registration(clouds[j], clouds[i], reach, T)
            if there.fitness >= self.least:
                found = reg.registration_icp(clouds[j], clouds[i], reach, T, plane)
                motions[i, j] = np.array(found.transformation)
        return self._optimised(clouds, motions, T_world_i, reach)

    def _fine(self, lib: Any, scan: np.ndarray) -> Any:
        vectors = lib.utility.Vector3dVector(scan.astype(np.float64))
        cloud = lib.geometry.PointCloud(vectors).voxel_down_sample(self.fine)
        cloud.estimate_normals(lib.geometry.KDTreeSearchParamHybrid(3 * self.fine, 30))
        return cloud

    def _optimised(
        self, clouds: list[Any], motions: dict, T_world_i: np.ndarray, reach: float
    ) -> np.ndarray:
        lib: Any = importlib.import_module("open3d")
        reg = lib.pipelines.registration
        graph = reg.PoseGraph()
        for T in np.nan_to_num(T_world_i, nan=0.0):
            graph.nodes.append(reg.PoseGraphNode(T))
        for (i, j), T in motions.items():
            information = reg.get_information_matrix_from_point_clouds(
                clouds[j], clouds[i], reach, T
            )
            # An edge there from s to t maps s into t. Any may be wrong: all uncertain.
            graph.edges.append(reg.PoseGraphEdge(j, i, T, information, True))
        option = reg.GlobalOptimizationOption(
            max_correspondence_distance=reach,
            edge_prune_threshold=self.prune,
            reference_node=0,
        )
        reg.global_optimization(
            graph,
            reg.GlobalOptimizationLevenbergMarquardt(),
            reg.GlobalOptimizationConvergenceCriteria(),
            option,
        )
        found = np.stack([np.asarray(node.pose) for node in graph.nodes])
        return np.where(np.isnan(T_world_i), np.nan, found)


def _without_noise(scan: np.ndarray, num: int, radius: float) -> np.ndarray:
    lib: Any = importlib.import_module("open3d")
    vectors = lib.utility.Vector3dVector(scan.astype(np.float64))
    cloud, _ = lib.geometry.PointCloud(vectors).remove_radius_outlier(num, radius)
    return np.asarray(cloud.points)


def _pairs(num: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(num) for j in range(i + 1, num)]


def _tree(motions: dict[tuple[int, int], np.ndarray], scores: np.ndarray) -> np.ndarray:
    """Poses along the tree of highest scores from scan 0."""
    num = len(scores)
    i, j = np.nonzero(scores)
    costs = coo_array((2 - scores[i, j], (i, j)), (num, num))
    tree = minimum_spanning_tree(costs.tocsr())
    order, parent = breadth_first_order(tree, 0, directed=False)
    T_world_i = np.full((num, 4, 4), np.nan)
    T_world_i[0] = np.eye(4)
    for v in order[1:].tolist():
        p = int(parent[v])
        T = motions[p, v] if p < v else np.linalg.inv(motions[v, p])
        T_world_i[v] = T_world_i[p] @ T
    return T_world_i
