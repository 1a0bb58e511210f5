"""Global registration as users of other libraries write it.

Each peer prepares a cloud once (`prepare`) and solves pairs of prepared clouds
(`solve`), so that many pairs of few clouds are fair to it. A solution is a pose and the
score by which its user would believe it: the share of points that have a counterpart.
Lengths are those of the caller.
"""

import importlib
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


class Answer(NamedTuple):
    """`T_target_source`, `(4, 4)`, and its score in [0, 1]."""

    T_target_source: np.ndarray
    score: float


class GicpStarts(NamedTuple):
    """The best of many ICPs of small_gicp from rotations uniform over SO(3).

    Centroids are put on each other. Two stages, the second from the ends of the first
    that bring most points near, as ends within reach are found by their scores. The
    score is the share of source points within `near` of the target.

    Attributes:
        kind: ICP, PLANE_ICP or GICP.
        starts: rotations.
        reach: largest distances of a pair, of every start and of the best one.
        near: distance that counts as agreement.
    """

    kind: str
    starts: int
    reach: tuple[float, float]
    near: float

    def prepare(self, points: np.ndarray) -> tuple[Any, Any]:
        """Cloud and tree, with what the factor reads."""
        lib: Any = importlib.import_module("small_gicp")
        cloud = lib.PointCloud(points.astype(np.float64))
        tree = lib.KdTree(cloud, 1)
        if self.kind == "PLANE_ICP":
            lib.estimate_normals(cloud, tree, 10, 1)
        if self.kind == "GICP":
            lib.estimate_covariances(cloud, tree, 10, 1)
        return cloud, tree

    def solve(self, source: Any, target: Any, seed: int) -> Answer:
        """All starts, then the best once more with the narrow reach."""
        rotations = Rotation.random(self.starts, rng=np.random.default_rng(seed))
        points, other = (np.asarray(x[0].points())[:, :3] for x in (source, target))
        best = Answer(np.eye(4), -1.0)
        for R in rotations.as_matrix():
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, other.mean(0) - R @ points.mean(0)
            T = self._align(source, target, T, self.reach[0])
            score = self._score(points, target, T)
            best = Answer(T, score) if score > best.score else best
        T = self._align(source, target, best.T_target_source, self.reach[1])
        return Answer(T, self._score(points, target, T))

    def descend(self, source: Any, target: Any, T: np.ndarray) -> np.ndarray:
        """Both stages from one pose, without a search."""
        for reach in self.reach:
            T = self._align(source, target, T, reach)
        return T

    def _align(self, source: Any, target: Any, T: np.ndarray, reach: float) -> Any:
        lib: Any = importlib.import_module("small_gicp")
        found = lib.align(
            target[0], source[0], target[1], T, self.kind, reach, 1, 30, 2e-3, 1e-3
        )
        return found.T_target_source

    def _score(self, points: np.ndarray, target: Any, T: np.ndarray) -> float:
        moved = points @ T[:3, :3].T + T[:3, 3]
        square = np.asarray(target[1].batch_nearest_neighbor_search(moved, 1)[1])
        return float((square < self.near**2).mean())


class Features(NamedTuple):
    """FPFH of Open3D with RANSAC or FGR, then point-to-plane ICP on the thinned clouds.

    Settings as in Open3D's own tutorial on global registration: normals within two
    voxels, features within five, 1.5 voxels for a RANSAC inlier, half a voxel for FGR.

    Attributes:
        kind: RANSAC or FGR.
        voxel: side of the voxels that thin the clouds.
        iterations: of RANSAC at most.
        mutual: whether RANSAC's matches must be mutual.
        camera_at_origin: where normals point; else to where the surface bulges.
    """

    kind: str
    voxel: float
    iterations: int = 100_000
    mutual: bool = True
    camera_at_origin: bool = True

    def prepare(self, points: np.ndarray) -> tuple[Any, Any]:
        """Thinned cloud with normals, and features."""
        lib: Any = importlib.import_module("open3d")
        lib.utility.set_verbosity_level(lib.utility.VerbosityLevel.Error)
        reg, near = (
            lib.pipelines.registration,
            lib.geometry.KDTreeSearchParamHybrid,
        )
        vectors = lib.utility.Vector3dVector(points.astype(np.float64))
        cloud = lib.geometry.PointCloud(vectors).voxel_down_sample(self.voxel)
        cloud.estimate_normals(near(2 * self.voxel, 30))
        camera = np.zeros(3)
        if not self.camera_at_origin:
            centre, size = cloud.get_center(), np.ptp(points, axis=0).max()
            cloud.orient_normals_towards_camera_location(centre)
            camera = centre - 10 * size * np.asarray(cloud.normals).mean(axis=0)
        cloud.orient_normals_towards_camera_location(camera)
        return cloud, reg.compute_fpfh_feature(cloud, near(5 * self.voxel, 100))

    def solve(self, source: Any, target: Any, seed: int) -> Answer:
        """Coarse, then ICP within 1.5 voxels; the score is ICP's lesser share."""
        lib: Any = importlib.import_module("open3d")
        lib.utility.random.seed(seed)
        reg = lib.pipelines.registration
        reach = 1.5 * self.voxel
        (moving, few), (fixed, many) = source, target
        if self.kind == "FGR":
            option = reg.FastGlobalRegistrationOption(
                maximum_correspondence_distance=0.5 * self.voxel
            )
            coarse = reg.registration_fgr_based_on_feature_matching(
                moving, fixed, few, many, option
            )
        else:
            coarse = reg.registration_ransac_based_on_feature_matching(
                moving,
                fixed,
                few,
                many,
                self.mutual,
                reach,
                reg.TransformationEstimationPointToPoint(False),
                3,
                [
                    reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    reg.CorrespondenceCheckerBasedOnDistance(reach),
                ],
                reg.RANSACConvergenceCriteria(self.iterations, 0.999),
            )
        plane = reg.TransformationEstimationPointToPlane()
        found = reg.registration_icp(moving, fixed, reach, coarse.transformation, plane)
        T = np.array(found.transformation)
        back = reg.evaluate_registration(fixed, moving, reach, np.linalg.inv(T))
        return Answer(T, min(found.fitness, back.fitness))


_KISS_VOXEL = 0.3


class Kiss(NamedTuple):
    """KISS-Matcher: faster features, pruning by a graph of consistent pairs, and GNC.

    Then point-to-plane ICP of small_gicp on the same grid, as for the others; the score
    is the lesser share of points of either cloud within 1.5 voxels of the other.

    Attributes:
        voxel: side of the voxels that thin the clouds; other lengths follow from it.
    """

    voxel: float

    def prepare(self, points: np.ndarray) -> tuple[Any, Any, Any]:
        """Points as a list, which it takes, and what refines; it keeps no features."""
        lib: Any = importlib.import_module("small_gicp")
        cloud = lib.voxelgrid_sampling(points.astype(np.float64), self.voxel, 1)
        tree = lib.KdTree(cloud, 1)
        lib.estimate_normals(cloud, tree, 10, 1)
        # It refuses small voxels: points in the unit in which they are its default.
        scaled = (_KISS_VOXEL / self.voxel * points).astype(np.float32)
        return list(scaled), cloud, tree

    def solve(self, source: Any, target: Any, seed: int) -> Answer:
        """Coarse, then ICP within 1.5 voxels. It draws nothing: `seed` is not used."""
        kiss: Any = importlib.import_module("kiss_matcher")
        lib: Any = importlib.import_module("small_gicp")
        matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(_KISS_VOXEL))
        found = matcher.estimate(source[0], target[0])
        T, reach = np.eye(4), 1.5 * self.voxel
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        T[:3, 3] *= self.voxel / _KISS_VOXEL
        T = lib.align(
            target[1], source[1], target[2], T, "PLANE_ICP", reach, 1, 30, 2e-3, 1e-5
        ).T_target_source
        there = _near(source[1], target[2], T, reach)
        back = _near(target[1], source[2], np.linalg.inv(T), reach)
        return Answer(T, min(there, back))


def _near(cloud: Any, tree: Any, T: np.ndarray, reach: float) -> float:
    moved = np.asarray(cloud.points())[:, :3] @ T[:3, :3].T + T[:3, 3]
    square = np.asarray(tree.batch_nearest_neighbor_search(moved, 1)[1])
    return float((square < reach**2).mean())


Peer = GicpStarts | Features | Kiss


def scan_peers() -> dict[str, tuple[str, Peer]]:
    """For the scans, in metres; their points are 0.5 mm apart."""
    return {
        "Open3D FPFH + RANSAC": ("open3d", Features("RANSAC", 0.0025)),
        "Open3D FPFH + FGR": ("open3d", Features("FGR", 0.0025)),
        "KISS-Matcher": ("kiss-matcher", Kiss(0.0025)),
    }


def horse_peers() -> dict[str, tuple[str, Peer]]:
    """For horses 222 units long; points of the target are 4 apart.

    ICP takes the same time and finds fewer of the halves. Matchers of features are out
    of their depth: 400 points with noise among them have no normals to speak of.
    """
    starts = GicpStarts("PLANE_ICP", 40, (30.0, 12.0), 6.0)
    return {"small_gicp PLANE, 40 starts": ("small_gicp", starts)}
