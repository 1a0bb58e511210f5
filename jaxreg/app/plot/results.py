"""From solutions to what is shown of them, on the host."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxreg
from jaxreg._core.status import Status
from jaxreg.app.result import Result


MAX_COVARIANCES = 300  # poses; of all poses of a graph the matrix is dense


def result_of(
    solution: "jaxreg.RegistrationSolution | jaxreg.ReconstructionSolution",
    clouds: Sequence[np.ndarray],
    names: Sequence[str] | None,
) -> Result:
    """A solution on the host, in float64, with names and numbers of points."""
    status = Status(int(solution.status))
    size = np.array([len(x) for x in clouds])
    finite = np.array([np.isfinite(x).all(axis=1).sum() for x in clouds])
    if isinstance(solution, jaxreg.RegistrationSolution):
        T = np.asarray(solution.T_target_source, np.float64)
        found = status in (Status.CONVERGED, Status.MAX_STEPS, Status.AMBIGUOUS)
        poses = np.stack([np.eye(len(T)), T])
        component = np.where([True, found], 0, -1)
        scan_status = np.array([Status.CONVERGED, status])
        edges, T_i_j, keep = np.array([[0, 1]]), T[None], slice(None)
        weight = np.array([float(found)])
        labels = ["target", "source"]
    else:
        poses = np.asarray(solution.T_world_i, np.float64)
        component = np.asarray(solution.component)
        scan_status = np.asarray(solution.scan_status)
        keep = np.asarray(solution.graph.mask)
        edges = np.asarray(solution.graph.edges)[keep]
        T_i_j = np.asarray(solution.graph.T_i_j, np.float64)[keep]
        weight = np.asarray(solution.edge_weight)[keep]
        labels = [f"scan {k}" for k in range(len(poses))]
    return Result(
        names=labels if names is None else list(names),
        T_world_i=poses,
        component=component,
        status=status,
        scan_status=scan_status,
        num_points=size,
        num_dropped=size - finite,
        edges=edges,
        T_i_j=T_i_j,
        overlap=np.atleast_1d(solution.overlap)[keep],
        weight=weight,
        inlier_rmse=np.atleast_1d(solution.inlier_rmse)[keep],
        trace=solution.trace,
    )


def residuals(
    T_world_i: np.ndarray, edges: np.ndarray, T_i_j: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far relative motions are from what the poses say of them.

    Args:
        T_world_i: `(v, d+1, d+1)` poses.
        edges: `(e, 2)` frames i and j.
        T_i_j: `(e, d+1, d+1)` motions.

    Returns:
        `(e,)` angles in radians and `(e,)` distances of the origin of frame j.
    """
    i, j = np.asarray(edges).T
    T = np.asarray(T_world_i, np.float64)
    gap = np.asarray(T_i_j, np.float64) - np.linalg.inv(T[i]) @ T[j]
    # The Frobenius norm of R - R' is 2 sqrt(2) sin(angle / 2).
    sine = np.linalg.norm(gap[:, :-1, :-1], axis=(1, 2)) / np.sqrt(8)
    return 2 * np.arcsin(np.minimum(sine, 1)), np.linalg.norm(gap[:, :-1, -1], axis=1)


def covariances_of(result: Result) -> np.ndarray | None:
    """Covariances `(v, k, k)` of poses: its own, else by its trusted pairs.

    The latter are those of `pose_covariances`: the first scan of each component is
    known exactly, and the noise is what its pairs
    show; NaN for components whose trusted pairs close no cycle. None for more than some
    hundred scans.
    """
    if result.covariances is not None:
        return result.covariances
    num, D = len(result.names), result.T_world_i.shape[-1]
    k = D * (D - 1) // 2
    if num > MAX_COVARIANCES:
        return None
    out = np.full((num, k, k), np.nan)
    for component in range(result.num_components):
        ids = np.flatnonzero(result.component == component)
        number = np.full(num, -1)
        number[ids] = np.arange(len(ids))
        edges = number[result.edges]
        keep = (edges >= 0).all(axis=1) & (result.weight > 0.5)
        if keep.sum() >= len(ids):
            out[ids] = _covariances(
                result.T_world_i[ids], edges[keep], result.T_i_j[keep]
            )
    return out


def _covariances(T_world_i: np.ndarray, edges: np.ndarray, T_i_j: np.ndarray) -> Any:
    graph = jaxreg.PoseGraph.from_edges(edges, T_i_j, num_poses=len(T_world_i))
    dtype, num = graph.T_i_j.dtype, graph.num_poses
    solution = jaxreg.AveragingSolution(
        T_world_i=jnp.asarray(T_world_i, dtype),
        edge_weight=jnp.ones(len(edges), dtype),
        agreement=jnp.ones((), dtype),
        status=jnp.asarray(Status.CONVERGED, jnp.int32),
        placed=jnp.ones(num, bool),
        component=jnp.zeros(num, jnp.int32),
        kernel_width=jnp.full(2, jnp.inf, dtype),
        num_steps=jnp.zeros((), jnp.int32),
        residual=jnp.zeros((), dtype),
        log_evidence=jnp.zeros((), dtype),
        length_scale=jnp.ones((), dtype),
    )
    return jaxreg.pose_covariances(graph, solution)
