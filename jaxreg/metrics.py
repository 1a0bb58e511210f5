"""How far estimated poses are from true ones, and how well poses fit a graph.

Errors are those of the MCC paper: e_R the mean angle between the rotations of the
same frame, e_t the mean distance between their translations. Poses carry a free common
frame (the gauge), so both sets are first brought into one.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.graph.pose_graph import PoseGraph, chordal_weights


Align = Literal["first", "best", "none"]


def align_poses(
    T_world_i: Float[Array, "v D D"],
    T_true_i: Float[Array, "v D D"],
    align: Align = "first",
    mask: Bool[Array, " v"] | None = None,
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

    Gradients: with respect to both sets of poses.
    """
    if align == "none":
        return T_world_i
    if align == "first":
        return T_true_i[0] @ lie.inverse(T_world_i[0]) @ T_world_i
    if align != "best":
        raise ValueError(f"align: wanted 'first', 'best' or 'none', found {align!r}.")
    dtype = T_world_i.dtype
    w = jnp.ones(T_world_i.shape[:1], dtype) if mask is None else mask.astype(dtype)
    w = w / jnp.maximum(jnp.sum(w), 1)
    R_est, R_true = lie.rotation(T_world_i), lie.rotation(T_true_i)
    # Relative rotations R_true_i inv(R_est_i) are all the same up to error.
    R = nearest_rotation(jnp.einsum("v,vij,vkj->ik", w, R_true, R_est))
    moved = lie.compose(R, jnp.zeros(R.shape[:1], dtype)) @ T_world_i
    shift = w @ (lie.translation(T_true_i) - lie.translation(moved))
    return lie.compose(lie.rotation(moved), lie.translation(moved) + shift)


@eqx.filter_jit
def rotation_errors(
    T_world_i: Float[Array, "v D D"],
    T_true_i: Float[Array, "v D D"],
    align: Align = "first",
    mask: Bool[Array, " v"] | None = None,
) -> Float[Array, " v"]:
    """The angle between estimated and true rotation of each frame, in radians."""
    T = align_poses(T_world_i, T_true_i, align, mask)
    R = lie.rotation(T) @ jnp.swapaxes(lie.rotation(T_true_i), -1, -2)
    return lie.rotation_angle(R)


@eqx.filter_jit
def translation_errors(
    T_world_i: Float[Array, "v D D"],
    T_true_i: Float[Array, "v D D"],
    align: Align = "first",
    mask: Bool[Array, " v"] | None = None,
) -> Float[Array, " v"]:
    """The distance between estimated and true translation of each frame."""
    T = align_poses(T_world_i, T_true_i, align, mask)
    sq = jnp.sum((lie.translation(T) - lie.translation(T_true_i)) ** 2, axis=-1)
    return jnp.where(sq > 0, jnp.sqrt(jnp.where(sq > 0, sq, 1)), 0)


def rotation_error(
    T_world_i: Float[Array, "v D D"],
    T_true_i: Float[Array, "v D D"],
    align: Align = "first",
    mask: Bool[Array, " v"] | None = None,
) -> Float[Array, ""]:
    """e_R of the MCC paper: the mean over the frames in `mask`, in radians.

    >>> import jax.numpy as jnp
    >>> from jaxreg import metrics
    >>> T = jnp.stack([jnp.eye(3), jnp.eye(3)])
    >>> turned = T.at[1, :2, :2].set(jnp.array([[0.0, -1.0], [1.0, 0.0]]))
    >>> print(f"{metrics.rotation_error(turned, T):.3f}")  # pi / 2 on one of two
    0.785
    """
    return _mean(rotation_errors(T_world_i, T_true_i, align, mask), mask)


def translation_error(
    T_world_i: Float[Array, "v D D"],
    T_true_i: Float[Array, "v D D"],
    align: Align = "first",
    mask: Bool[Array, " v"] | None = None,
) -> Float[Array, ""]:
    """e_t of the MCC paper: the mean over the frames in `mask`, in their unit."""
    return _mean(translation_errors(T_world_i, T_true_i, align, mask), mask)


def _mean(x: Array, mask: Array | None) -> Array:
    if mask is None:
        return jnp.mean(x)
    count = jnp.maximum(jnp.sum(mask), 1).astype(x.dtype)
    return jnp.sum(jnp.where(mask, x, 0)) / count


@eqx.filter_jit
def chordal_objective(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"]
) -> Float[Array, ""]:
    """SE-Sync's objective F of poses, without a factor 1/2.

    Sum over the edges of kappa |R_j - R_i R_i_j|_F^2 + tau |t_j - t_i - R_i t_i_j|^2.

    Reference: Rosen, Carlone, Bandeira, Leonard 2019.
    """
    kappa, tau = chordal_weights(graph)
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    gap = (T_world_i[j] - T_world_i[i] @ graph.T_i_j)[:, :-1]
    rotation = jnp.sum(gap[..., :-1] ** 2, axis=(-2, -1))
    translation = jnp.sum(gap[..., -1] ** 2, axis=-1)
    return jnp.sum(kappa * rotation + tau * translation)
