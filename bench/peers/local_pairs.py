"""Local registration as users of other libraries write it, from raw points to pose.

Each peer is a function of source `(n, 3)` float32, target `(m, 3)` float32 and the
extent of the object (diagonal of its bounding box, which a user knows) that returns
`T_target_source`, `(4, 4)` float64. All start from the identity. Conversion of the
points, normals, covariances and trees are inside. Distances are shares of the extent.
"""

import importlib
from typing import Any

import numpy as np
from scipy.spatial import KDTree


def numpy_normals(points: np.ndarray, tree: KDTree, k: int) -> np.ndarray:
    """Unit normals from the k nearest points."""
    near = points[np.asarray(tree.query(points, k)[1])]
    near = near - near.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]


def exponential(twist: np.ndarray) -> np.ndarray:
    """The motion of a small twist (shift, turn), exact in the turn."""
    shift, turn = twist[:3], twist[3:]
    angle = max(float(np.linalg.norm(turn)), 1e-12)
    x, y, z = turn / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)
    T[:3, 3] = shift
    return T


def numpy_plane(
    source: np.ndarray,
    target: np.ndarray,
    extent: float,
    *,
    reach: float,
    k: int,
    steps: int,
    stop: float,
) -> np.ndarray:
    """Point-to-plane ICP with SciPy's tree and Huber weights at the median residual."""
    source, target = source.astype(np.float64), target.astype(np.float64)
    tree = KDTree(target)
    normals = numpy_normals(target, tree, k)
    T = np.eye(4)
    for _ in range(steps):
        moved = source @ T[:3, :3].T + T[:3, 3]
        found = tree.query(moved, distance_upper_bound=reach * extent)
        distance, row = (np.asarray(x) for x in found)
        met = np.isfinite(distance)
        p, n = moved[met], normals[row[met]]
        residual = np.einsum("ni,ni->n", p - target[row[met]], n)
        size = np.abs(residual)
        width = 1.5 * np.median(size) + 1e-12
        weight = np.minimum(1, width / np.maximum(size, 1e-300))
        centre = p.mean(0)  # turning about the centroid conditions the equations
        J = np.concatenate([n, np.cross(p - centre, n)], axis=1)
        H = (J * weight[:, None]).T @ J
        twist = -np.linalg.solve(H, J.T @ (weight * residual))
        step = exponential(twist)
        step[:3, 3] += centre - step[:3, :3] @ centre
        T = step @ T
        if max(np.linalg.norm(twist[:3]) / extent, np.linalg.norm(twist[3:])) < stop:
            break
    return T


def small_gicp(
    source: np.ndarray,
    target: np.ndarray,
    extent: float,
    *,
    kind: str,
    stages: tuple[tuple[float, float], ...],
    k: int = 10,
    turn_deg: float = 0.1,
    shift: float = 1e-3,
    threads: int = 1,
) -> np.ndarray:
    """`align` of small_gicp, once per stage (voxel size, or 0 for none; reach).

    Only what the factor reads is computed: normals of the target for PLANE_ICP,
    covariances of both for GICP.
    """
    lib: Any = importlib.import_module("small_gicp")
    T = np.eye(4)
    stop = {
        "max_iterations": 50,
        "rotation_epsilon": np.radians(turn_deg),
        "translation_epsilon": shift * extent,
    }
    clouds = [lib.PointCloud(x.astype(np.float64)) for x in (source, target)]
    for voxel, reach in stages:
        moving, fixed = clouds
        if voxel:
            moving, fixed = (
                lib.voxelgrid_sampling(x, voxel * extent, threads) for x in clouds
            )
        tree = lib.KdTree(fixed, threads)
        if kind == "PLANE_ICP":
            lib.estimate_normals(fixed, tree, k, threads)
        if kind == "GICP":
            lib.estimate_covariances(fixed, tree, k, threads)
            own = lib.KdTree(moving, threads)
            lib.estimate_covariances(moving, own, k, threads)
        T = lib.align(
            fixed, moving, tree, T, kind, reach * extent, threads, **stop
        ).T_target_source
    return T


def small_vgicp(
    source: np.ndarray,
    target: np.ndarray,
    extent: float,
    *,
    cell: float,
    voxel: float,
    reach: float,
) -> np.ndarray:
    """VGICP of small_gicp by its one-call helper."""
    lib: Any = importlib.import_module("small_gicp")
    return lib.align(
        target.astype(np.float64),
        source.astype(np.float64),
        np.eye(4),
        registration_type="VGICP",
        voxel_resolution=cell * extent,
        downsampling_resolution=voxel * extent,
        max_correspondence_distance=reach * extent,
        num_threads=1,
        max_iterations=50,
        translation_epsilon=1e-3 * extent,
    ).T_target_source


def open3d(
    source: np.ndarray,
    target: np.ndarray,
    extent: float,
    *,
    kind: str,
    stages: tuple[tuple[float, float], ...],
    k: int = 20,
    stop: float = 1e-6,
) -> np.ndarray:
    """ICP of Open3D, once per stage (voxel size, or 0 for none; reach)."""
    lib: Any = importlib.import_module("open3d")
    reg = lib.pipelines.registration
    near = lib.geometry.KDTreeSearchParamKNN(k)
    criteria = reg.ICPConvergenceCriteria(stop, stop, 60)
    vectors = lib.utility.Vector3dVector
    clouds = [
        lib.geometry.PointCloud(vectors(x.astype(np.float64))) for x in (source, target)
    ]
    T = np.eye(4)
    for voxel, reach in stages:
        moving, fixed = clouds
        if voxel:
            moving, fixed = (x.voxel_down_sample(voxel * extent) for x in clouds)
        run, estimate = (
            reg.registration_icp,
            reg.TransformationEstimationPointToPoint(),
        )
        if kind == "plane":
            fixed.estimate_normals(near)
            estimate = reg.TransformationEstimationPointToPlane()
        if kind == "gicp":
            moving.estimate_covariances(near)
            fixed.estimate_covariances(near)
            run = reg.registration_generalized_icp
            estimate = reg.TransformationEstimationForGeneralizedICP()
        T = run(moving, fixed, reach * extent, T, estimate, criteria).transformation
    return np.asarray(T)


def open3d_tensor(
    source: np.ndarray,
    target: np.ndarray,
    extent: float,
    *,
    stages: tuple[tuple[float, float], ...],
    k: int,
) -> np.ndarray:
    """Multi-scale point-to-plane ICP of Open3D's tensor interface, in float32."""
    lib: Any = importlib.import_module("open3d")
    reg = lib.t.pipelines.registration
    moving, fixed = (
        lib.t.geometry.PointCloud(lib.core.Tensor(x)) for x in (source, target)
    )
    fixed.estimate_normals(max_nn=k)
    vector = lib.utility.DoubleVector
    return reg.multi_scale_icp(
        moving,
        fixed,
        vector([v * extent if v else -1.0 for v, _ in stages]),
        [reg.ICPConvergenceCriteria(1e-6, 1e-6, 60)] * len(stages),
        vector([reach * extent for _, reach in stages]),
        lib.core.Tensor(np.eye(4)),
        reg.TransformationEstimationPointToPlane(),
    ).transformation.numpy()


def filter_reg(
    source: np.ndarray, target: np.ndarray, extent: float, *, sigma: float
) -> np.ndarray:
    """FilterReg of probreg, point-to-plane, its width starting at a share of extent."""
    lib: Any = importlib.import_module("probreg.filterreg")
    target = target.astype(np.float64)
    found = lib.registration_filterreg(
        source.astype(np.float64),
        target,
        numpy_normals(target, KDTree(target), 10),
        sigma2=(sigma * extent) ** 2,
        update_sigma2=True,
        objective_type="pt2pl",
        maxiter=50,
        tol=1e-6 * extent,
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.transformation.rot, found.transformation.t
    return T


def coherent_drift(
    source: np.ndarray, target: np.ndarray, extent: float, *, steps: int
) -> np.ndarray:
    """Rigid coherent point drift of pycpd, in the unit of the extent."""
    lib: Any = importlib.import_module("pycpd")
    moving, fixed = (x.astype(np.float64) / extent for x in (source, target))
    solver = lib.RigidRegistration(X=fixed, Y=moving, scale=False, max_iterations=steps)
    solver.register()
    T = np.eye(4)
    # Points are rows there: moved = points @ R + t.
    T[:3, :3], T[:3, 3] = solver.R.T, extent * np.ravel(solver.t)
    return T
