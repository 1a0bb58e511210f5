"""How far estimated poses are from true ones, and how well poses fit a graph.

Errors are those of the MCC paper: e_R the mean angle between the rotations of the
same frame, e_t the mean distance between their translations. Poses carry a free common
frame (the gauge), so both sets are first brought into one.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import (
    as_float_array,
    as_host_numbers,
    check_count,
    check_mask,
    shown,
)
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.geometry import lie
from jaxreg.geometry.kabsch import kabsch
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.graph.chordal import chordal_weights
from jaxreg.graph.pose_graph import PoseGraph, check_graph, check_poses


Align = Literal["first", "best", "positions", "none"]
_ALIGN = ("first", "best", "positions", "none")


def align_poses(
    T_world_i: ArrayLike,
    T_true_i: ArrayLike,
    align: Align = "first",
    mask: ArrayLike | None = None,
) -> Float[Array, "v D D"]:
    """The estimate in the frame of the truth.

    Args:
        T_world_i: `(v, d+1, d+1)` estimated poses.
        T_true_i: `(v, d+1, d+1)` true poses of the same frames.
        align: "first" so that frame 0 agrees, "best" for the rotation nearest to all
            rotations of the frames, then the best translation, "positions" for the
            motion that brings the positions together (Umeyama, as `evo -a` does),
            "none" for no change.
        mask: `(v,)` the frames that count for "best" and "positions", None for all.

    Returns:
        `T_true_world @ T_world_i`.

    Raises:
        ValueError, TypeError: for shapes and dtypes that do not fit, as do all here.

    Gradients: with respect to both sets of poses.
    """
    return _aligned(*_checked(T_world_i, T_true_i, align, mask))


def _aligned(T_world_i: Array, T_true_i: Array, align: Align, mask: Array) -> Array:
    if align == "none":
        return T_world_i
    if align == "first":
        return T_true_i[0] @ lie.between(T_world_i[0], T_world_i)
    dtype = T_world_i.dtype
    if align == "positions":
        positions = lie.translation(T_world_i), lie.translation(T_true_i)
        return kabsch(*positions, mask.astype(dtype)) @ T_world_i
    w = mask.astype(dtype)
    w = w / jnp.maximum(jnp.sum(w), 1)
    R_est, R_true = lie.rotation(T_world_i), lie.rotation(T_true_i)
    # Relative rotations R_true_i inv(R_est_i) are all the same up to error.
    R = nearest_rotation(jnp.einsum("v,vij,vkj->ik", w, R_true, R_est))
    moved = lie.compose(R, jnp.zeros(R.shape[:1], dtype)) @ T_world_i
    shift = w @ (lie.translation(T_true_i) - lie.translation(moved))
    return lie.compose(lie.rotation(moved), lie.translation(moved) + shift)


def _checked(
    T_world_i: object, T_true_i: object, align: object, mask: object
) -> tuple[Array, Array, Align, Array]:
    """Two sets of as many poses, and which of them count."""
    if not isinstance(align, str) or align not in _ALIGN:
        raise ValueError(f"align: wanted one of {_ALIGN}, found {shown(align)}.")
    T = as_float_array(T_world_i, "T_world_i")
    if T.ndim != 3 or T.shape[1:] not in ((3, 3), (4, 4)) or not len(T):
        raise ValueError(
            f"T_world_i: wanted shape (v, 3, 3) or (v, 4, 4), found {T.shape}."
        )
    T_true = as_float_array(T_true_i, "T_true_i")
    if T_true.shape != T.shape:
        raise ValueError(
            f"T_true_i: wanted shape {T.shape} like T_world_i, found {T_true.shape}."
        )
    return T, T_true, align, check_mask(mask, T.shape[:1], "mask")


def rotation_errors(
    T_world_i: ArrayLike,
    T_true_i: ArrayLike,
    align: Align = "first",
    mask: ArrayLike | None = None,
) -> Float[Array, " v"]:
    """The angle between estimated and true rotation of each frame, in radians."""
    return _rotation_errors(*_checked(T_world_i, T_true_i, align, mask))


@kept_program
def _rotation_errors(
    T_world_i: Array, T_true_i: Array, align: Align, mask: Array
) -> Array:
    T = _aligned(T_world_i, T_true_i, align, mask)
    R = lie.rotation(T) @ jnp.swapaxes(lie.rotation(T_true_i), -1, -2)
    return lie.rotation_angle(R)


def translation_errors(
    T_world_i: ArrayLike,
    T_true_i: ArrayLike,
    align: Align = "first",
    mask: ArrayLike | None = None,
) -> Float[Array, " v"]:
    """The distance between estimated and true translation of each frame."""
    return _translation_errors(*_checked(T_world_i, T_true_i, align, mask))


@kept_program
def _translation_errors(
    T_world_i: Array, T_true_i: Array, align: Align, mask: Array
) -> Array:
    T = _aligned(T_world_i, T_true_i, align, mask)
    sq = jnp.sum((lie.translation(T) - lie.translation(T_true_i)) ** 2, axis=-1)
    return jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)


def relative_errors(
    T_world_i: ArrayLike, T_true_i: ArrayLike, delta: int = 1
) -> tuple[Float[Array, " r"], Float[Array, " r"]]:
    """Relative pose errors: how motions between frames differ from the true ones.

    Of the frames 0, delta, 2 delta, ... each with the next one, as evo has them. No
    common frame is needed.

    Args:
        T_world_i: `(v, d+1, d+1)` estimated poses.
        T_true_i: `(v, d+1, d+1)` true poses of the same frames.
        delta: frames between the two of a motion.

    Returns:
        The angles in radians and the lengths of
        inv(inv(T_true_i) T_true_j) inv(T_world_i) T_world_j.
    """
    check_count(delta, "delta")
    T, T_true, _, _ = _checked(T_world_i, T_true_i, "none", None)
    return _relative_errors(T[::delta], T_true[::delta])


@kept_program
def _relative_errors(T: Array, T_true: Array) -> tuple[Array, Array]:
    found = lie.between(T[:-1], T[1:])
    gap = lie.between(lie.between(T_true[:-1], T_true[1:]), found)
    sq = jnp.sum(lie.translation(gap) ** 2, axis=-1)
    length = jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)
    return lie.rotation_angle(lie.rotation(gap)), length


def rotation_error(
    T_world_i: ArrayLike,
    T_true_i: ArrayLike,
    align: Align = "first",
    mask: ArrayLike | None = None,
) -> Float[Array, ""]:
    """e_R of the MCC paper: the mean over the frames in `mask`, in radians.

    >>> import jax.numpy as jnp
    >>> from jaxreg import metrics
    >>> T = jnp.stack([jnp.eye(3), jnp.eye(3)])
    >>> turned = T.at[1, :2, :2].set(jnp.array([[0.0, -1.0], [1.0, 0.0]]))
    >>> print(f"{metrics.rotation_error(turned, T):.3f}")  # pi / 2 on one of two
    0.785
    """
    checked = _checked(T_world_i, T_true_i, align, mask)
    return _mean(_rotation_errors(*checked), checked[-1])


def translation_error(
    T_world_i: ArrayLike,
    T_true_i: ArrayLike,
    align: Align = "first",
    mask: ArrayLike | None = None,
) -> Float[Array, ""]:
    """e_t of the MCC paper: the mean over the frames in `mask`, in their unit."""
    checked = _checked(T_world_i, T_true_i, align, mask)
    return _mean(_translation_errors(*checked), checked[-1])


def _mean(x: Array, mask: Array) -> Array:
    count = jnp.maximum(jnp.sum(mask), 1).astype(x.dtype)
    return jnp.sum(jnp.where(mask, x, 0)) / count


def chordal_objective(graph: PoseGraph, T_world_i: ArrayLike) -> Float[Array, ""]:
    """SE-Sync's objective F of poses, without a factor 1/2.

    Sum over the edges of kappa |R_j - R_i R_i_j|_F^2 + tau |t_j - t_i - R_i t_i_j|^2.

    Reference: Rosen, Carlone, Bandeira, Leonard 2019.
    """
    one = check_graph(graph, "graph")
    return _chordal_objective(one, check_poses(T_world_i, "T_world_i", one))


@kept_program
def _chordal_objective(graph: PoseGraph, T_world_i: Array) -> Array:
    kappa, tau = chordal_weights(graph)
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    gap = (T_world_i[j] - T_world_i[i] @ graph.T_i_j)[:, :-1]
    rotation = jnp.sum(gap[..., :-1] ** 2, axis=(-2, -1))
    translation = jnp.sum(gap[..., -1] ** 2, axis=-1)
    return jnp.sum(kappa * rotation + tau * translation)


class Recall(NamedTuple):
    """Of motions of pairs of fragments, as 3DMatch counts them.

    Attributes:
        recall: share of the true pairs whose motion is found.
        precision: share of the motions found that are right; NaN without any.
        num_right: motions that are right.
        num_true: pairs of the truth that count.
        num_found: motions of the estimate that count.
        rmse: `(num_true,)` of each of these pairs; infinite where no motion is found.
    """

    recall: float
    precision: float
    num_right: int
    num_true: int
    num_found: int
    rmse: np.ndarray


def registration_recall(
    graph: PoseGraph,
    T_true: PoseGraph,
    information: ArrayLike,
    threshold: float = 0.2,
) -> Recall:
    """Registration recall and precision of the Redwood and 3DMatch benchmarks.

    A motion is right where points that truly coincide are at most `threshold` apart,
    root mean square, by their information matrix: with the gap inv(T_true) T_found as
    e = (translation, vector part of the quaternion), e' information e / information[0,
    0] is that distance squared. Pairs of successive fragments do not count. The pair
    (j, i) counts as (i, j), its motion inverted.

    Args:
        graph: the motions found, 3D.
        T_true: the true motions; its pairs have i < j.
        information: `(e, 6, 6)` of its edges, as `io.read_info` reads them.
        threshold: in the unit of the motions; the benchmark takes 0.2 m.

    References: Choi, Zhou, Koltun 2015; Zeng et al. 2017.
    """
    found = _motions_by_pair(check_graph(graph, "graph"), "graph")
    true = _motions_by_pair(check_graph(T_true, "T_true"), "T_true")
    info = as_host_numbers(information, "information")
    if info.shape != (T_true.num_edges, 6, 6):
        raise ValueError(
            f"information: wanted shape ({T_true.num_edges}, 6, 6), one for each true "
            f"motion, found {info.shape}."
        )
    found = {pair: x for pair, x in found.items() if pair[1] - pair[0] > 1}
    true = {pair: x for pair, x in true.items() if pair[1] - pair[0] > 1}
    rmse = [
        _coincidence(found[pair][0], T, info[row]) if pair in found else np.inf
        for pair, (T, row) in true.items()
    ]
    right = int(np.sum(np.array(rmse) <= threshold))
    return Recall(
        right / len(true) if true else np.nan,
        right / len(found) if found else np.nan,
        right,
        len(true),
        len(found),
        np.array(rmse),
    )


def _motions_by_pair(
    graph: PoseGraph, name: str
) -> dict[tuple[int, int], tuple[np.ndarray, int]]:
    """`T_i_j` with i < j and its row."""
    if graph.dim != 3:
        raise ValueError(f"{name}: wanted 3D, found {graph.dim}D.")
    out = {}
    T = np.asarray(graph.T_i_j, np.float64)
    for row in np.flatnonzero(np.asarray(graph.mask)).tolist():
        i, j = (int(k) for k in graph.edges[row])
        motion = T[row] if i < j else np.linalg.inv(T[row])
        out[min(i, j), max(i, j)] = motion, row
    return out


def _coincidence(T: np.ndarray, T_true: np.ndarray, information: np.ndarray) -> float:
    from scipy.spatial.transform import Rotation  # at use: it is slow to import

    gap = np.linalg.inv(T_true) @ T
    xyzw = Rotation.from_matrix(gap[:3, :3]).as_quat(canonical=True)
    e = np.concatenate([gap[:3, 3], xyzw[:3]])
    return float(np.sqrt(e @ information @ e / information[0, 0]))
