"""How far estimated poses are from true ones, and how well poses fit a graph.

Errors are those of the MCC paper: e_R the mean angle between the rotations of the
same frame, e_t the mean distance between their translations. Poses carry a free common
frame (the gauge), so both sets are first brought into one.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.checks import as_float_array, check_mask, shown
from jaxreg._core.typing import ArrayLike
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.graph.pose_graph import (
    PoseGraph,
    check_graph,
    check_poses,
    chordal_weights,
)


Align = Literal["first", "best", "none"]


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
            rotations of the frames, then the best translation, "none" for no change.
        mask: `(v,)` the frames that count for "best", None for all.

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
        return T_true_i[0] @ lie.inverse(T_world_i[0]) @ T_world_i
    dtype = T_world_i.dtype
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
    if not isinstance(align, str) or align not in ("first", "best", "none"):
        raise ValueError(
            f"align: wanted 'first', 'best' or 'none', found {shown(align)}."
        )
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


@eqx.filter_jit
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


@eqx.filter_jit
def _translation_errors(
    T_world_i: Array, T_true_i: Array, align: Align, mask: Array
) -> Array:
    T = _aligned(T_world_i, T_true_i, align, mask)
    sq = jnp.sum((lie.translation(T) - lie.translation(T_true_i)) ** 2, axis=-1)
    return jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)


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


@eqx.filter_jit
def _chordal_objective(graph: PoseGraph, T_world_i: Array) -> Array:
    kappa, tau = chordal_weights(graph)
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    gap = (T_world_i[j] - T_world_i[i] @ graph.T_i_j)[:, :-1]
    rotation = jnp.sum(gap[..., :-1] ** 2, axis=(-2, -1))
    translation = jnp.sum(gap[..., -1] ** 2, axis=-1)
    return jnp.sum(kappa * rotation + tau * translation)
