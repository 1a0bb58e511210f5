"""How well a graph determines the poses that were averaged from it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import as_host_array, check_count, is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.measures import deviations
from jaxreg.averaging.steps.gauss_newton import normal_equations, precisions
from jaxreg.averaging.world.adjusted import Told, as_adjusted
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def pose_covariances(
    graph: PoseGraph,
    solution: AveragingSolution,
    *,
    poses: ArrayLike | None = None,
    max_unknowns: int = 6000,
    priors: Told = None,
    fixed: Told = None,
    control: Told = None,
    levels: Told = None,
) -> Float[Array, "p k k"]:
    """The marginal covariance of each pose, with frame 0 known exactly.

    Of right tangents x in T_world_i exp(x), translation first, as g2o and GTSAM give
    them: the diagonal blocks of inv(J' W J) with W the information of each edge times
    prior weight and `edge_weight`. Without information the noise is taken to be what
    the edges show: one variance for translations and one for rotations, from the
    errors that the poses leave.

    Args:
        graph: the graph that was averaged.
        solution: its solution, from any method.
        poses: numbers of p frames, to have those alone, of graphs of any size: by
            sparse solves in float64, on the host and without jit; None for all v.
        max_unknowns: k per frame, at most, for all poses; the matrix is dense, 144 MB
            of float32 for the default (static).
        priors: those that `average` was given; then frame 0 is held by nothing else.
        fixed: likewise.
        control: likewise.
        levels: likewise.

    Returns:
        `(p, k, k)`, in the order of `poses`, or of the v frames; 0 for frame 0, or for
        fixed frames; NaN for frames that no trusted edge holds, and where the equations
        are not solved.

    Raises:
        ValueError: for more unknowns than `max_unknowns`, for a solution of another
            graph, and for poses that are no frames.
        TypeError: for anything but a graph and a solution, for poses that are no
            integers, and with `poses` while tracing.

    Gradients: none (cut).
    """
    if poses is not None and not all(
        map(is_concrete, jax.tree.leaves((graph, solution, poses)))
    ):
        raise TypeError("poses: solves run on the host, not inside jit, vmap or grad.")
    whole, placed, first = as_adjusted(graph, solution, priors, fixed, control, levels)
    check_count(max_unknowns, "max_unknowns")
    frozen = np.array([row[0] for row in fixed or ()], np.int32)
    if poses is not None:
        return _of_chosen(graph, whole, placed, poses, first, frozen)
    k = lie.tangent_dim(graph.dim)
    if graph.num_poses * k > max_unknowns:
        raise ValueError(
            f"graph: wanted at most {max_unknowns // k} poses for covariances, "
            f"found {graph.num_poses}; poses= asks for those of some frames."
        )
    covariances = _covariances(whole, placed)[first:]
    if not fixed:
        return covariances
    return covariances.at[jax.device_put(frozen)].set(0)


def _of_chosen(
    graph: PoseGraph,
    whole: PoseGraph,
    placed: AveragingSolution,
    poses: object,
    first: int,
    frozen: np.ndarray,
) -> Float[Array, "p k k"]:
    """Those of frames of the graph, which are `first` further in the whole."""
    # SciPy's sparse solvers take half a second to import.
    from jaxreg.averaging.selected_covariance import selected_covariances

    frames = _checked_frames(poses, graph.num_poses)
    covariances = selected_covariances(whole, placed, frames + first)
    covariances[np.isin(frames, frozen)] = 0
    with np.errstate(over="ignore"):
        return jax.device_put(covariances.astype(whole.T_i_j.dtype))


def _checked_frames(poses: object, num: int) -> np.ndarray:
    """Numbers of frames, `(p,)`."""
    wanted, frames = "poses: wanted frames' numbers", as_host_array(poses, "poses")
    if frames.ndim != 1 or not len(frames):
        raise ValueError(
            f"{wanted} in a sequence, at least one, found shape {frames.shape}."
        )
    if frames.dtype.kind not in "iu":
        raise TypeError(f"{wanted}, found dtype {frames.dtype}.")
    wrong = frames[(frames < 0) | (frames >= num)]
    if len(wrong):
        raise ValueError(f"{wanted} from 0 to {num - 1}, found {wrong[0]}.")
    return frames.astype(np.int64)


@kept_program
def _covariances(
    graph: PoseGraph, solution: AveragingSolution
) -> Float[Array, "v k k"]:
    graph, solution = jax.lax.stop_gradient((graph, solution))
    num, k = graph.num_poses, lie.tangent_dim(graph.dim)
    usable = jnp.all(jnp.isfinite(graph.T_i_j), axis=(1, 2)) & graph.mask
    trust = jnp.where(usable, solution.edge_weight, 0)
    T = solution.T_world_i
    deviation = deviations(graph, T, trust)
    W = precisions(graph, trust, deviation)
    if graph.information is None:
        W = W / deviation[1] ** 2
    H, _ = normal_equations(graph, T, jnp.where(usable[:, None, None], W, 0))
    root = jax.lax.rsqrt(jnp.diagonal(H))
    factor = jnp.linalg.cholesky(H * root[:, None] * root[None, :])
    eye = jnp.eye(num * k, dtype=H.dtype)
    half = jax.lax.linalg.triangular_solve(factor, eye, left_side=True, lower=True)
    columns = (half * root[None, :]).reshape(num * k, num, k)
    blocks = jnp.einsum("nva,nvb->vab", columns, columns)
    touched = jnp.zeros((num,), trust.dtype)
    touched = touched.at[graph.edges[:, 0]].add(trust)
    touched = touched.at[graph.edges[:, 1]].add(trust)
    known = solution.placed & (touched > 0)
    blocks = jnp.where(known[:, None, None], blocks, jnp.nan)
    return blocks.at[0].set(0)
