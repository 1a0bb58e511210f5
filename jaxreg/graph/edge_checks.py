"""What `PoseGraph.from_edges` refuses: on the host, where values are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxreg._core.checks import (
    ROTATION_TOLERANCE,
    as_float_array,
    as_host_array,
    is_concrete,
)


class EdgeError(ValueError):
    """A value of one edge that no graph can hold; `edge` is its row."""

    def __init__(self, message: str, edge: int):
        super().__init__(message)
        self.edge = edge


def check_ids(edges: object, num: int) -> Int[Array, "e 2"]:
    """Frames of edges as `(num, 2)` int32."""
    ids = edges if isinstance(edges, jax.Array) else as_host_array(edges, "edges")
    if not ids.size:
        ids = np.zeros((0, 2), np.int32)
    if ids.ndim != 2 or ids.shape != (num, 2):
        raise ValueError(
            f"edges: wanted shape ({num}, 2) as T_i_j has {num} rows, "
            f"found {ids.shape}."
        )
    if not jnp.issubdtype(ids.dtype, jnp.integer):
        raise TypeError(f"edges: wanted integers, found dtype {ids.dtype}.")
    if isinstance(ids, np.ndarray) and ids.size:
        if ids.max() > np.iinfo(np.int32).max or ids.min() < 0:
            raise ValueError(
                "edges: ids must lie between 0 and 2^31 - 1, found "
                f"{ids.min()} to {ids.max()}."
            )
    if isinstance(ids, np.ndarray):
        return jax.device_put(ids.astype(np.int32))
    return ids.astype(jnp.int32)


def check_extra(
    x: object, shape: tuple[int, ...], name: str, dtype: Any
) -> Array | None:
    """An optional array of a shape, in the dtype of the motions."""
    if x is None:
        return None
    out = as_float_array(x, name).astype(dtype)
    if out.shape != shape:
        raise ValueError(f"{name}: wanted shape {shape}, found {out.shape}.")
    return out


def count_poses(ids: Array, valid: Array) -> int:
    """The largest id plus one."""
    if not (is_concrete(ids) and is_concrete(valid)):
        raise ValueError("num_poses: must be given while tracing.")
    used = np.asarray(ids)[np.asarray(valid)]
    if not used.size:
        raise ValueError("num_poses: must be given for a graph without edges.")
    return int(used.max()) + 1


def _refuse(bad: Any, ids: Array, what: str) -> None:
    """Raises an error that names the first edge with `bad` True."""
    if bad.any():
        e = int(np.argmax(bad))
        pair = f" ({ids[e, 0]}, {ids[e, 1]})" if is_concrete(ids) else ""
        more = int(bad.sum()) - 1
        others = f" (and {more} more)" if more else ""
        raise EdgeError(f"edge {e}{pair}{others}: {what}", e)


def check_ids_values(ids: Array, valid: Array, num_poses: int) -> None:
    """Refuses frames out of range and edges from a frame to itself."""
    if not (is_concrete(ids) and is_concrete(valid)):
        return
    i, m = np.asarray(ids), np.asarray(valid)
    outside = ((i < 0) | (i >= num_poses)).any(axis=1) & m
    _refuse(outside, ids, f"ids must lie between 0 and {num_poses - 1}.")
    _refuse((i[:, 0] == i[:, 1]) & m, ids, "joins a frame with itself.")


def check_motions(motions: Array, ids: Array, valid: Array) -> Array:
    """The motions, those a little off SE(d) projected onto it; others are refused."""
    if not (is_concrete(motions) and is_concrete(valid)) or not motions.shape[0]:
        return motions
    T, m = np.asarray(motions, dtype=np.float64), np.asarray(valid)
    T = np.where(m[:, None, None], T, np.eye(T.shape[-1]))
    _refuse(~np.isfinite(T).all(axis=(1, 2)), ids, "T_i_j is not finite.")
    d = T.shape[-1] - 1
    _refuse(
        np.abs(T[:, d] - np.eye(d + 1)[d]).max(axis=1) > ROTATION_TOLERANCE,
        ids,
        f"the last row of T_i_j is not {[0] * d + [1]}.",
    )
    R = T[:, :d, :d]
    skewed = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(d)).max(axis=(1, 2))
    _refuse(
        (skewed > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0),
        ids,
        "the rotation of T_i_j is not orthonormal within "
        f"{ROTATION_TOLERANCE:g} or is a reflection.",
    )
    off = skewed > 4 * np.finfo(motions.dtype).eps
    if not off.any() and not (T[:, d] != np.eye(d + 1)[d]).any():
        return motions
    U, _, Vt = np.linalg.svd(R[off])
    T[off, :d, :d] = U @ Vt
    T[:, d] = np.eye(d + 1)[d]
    return jax.device_put(T.astype(motions.dtype))


def check_weights(weights: Array | None, ids: Array, valid: Array) -> None:
    """Refuses weights that are negative or not finite."""
    if weights is None or not (is_concrete(weights) and is_concrete(valid)):
        return
    w, m = np.asarray(weights), np.asarray(valid)
    _refuse((w < 0) & m, ids, "weight is negative.")
    _refuse(~np.isfinite(w) & m, ids, "weight is not finite.")


def check_information(info: Array | None, ids: Array, valid: Array) -> None:
    """Refuses matrices that are not finite, symmetric, or positive semidefinite."""
    if (
        info is None
        or not (is_concrete(info) and is_concrete(valid))
        or not info.shape[0]
    ):
        return
    M, m = np.asarray(info, dtype=np.float64), np.asarray(valid)
    M = np.where(m[:, None, None], M, 0)
    _refuse(~np.isfinite(M).all(axis=(1, 2)), ids, "information is not finite.")
    largest = np.abs(M).max(axis=(1, 2))
    lopsided = np.abs(M - np.swapaxes(M, 1, 2)).max(axis=(1, 2))
    _refuse(lopsided > 1e-5 * largest, ids, "information is not symmetric.")
    # Information matrices printed with six digits may be indefinite by rounding.
    lowest = np.linalg.eigvalsh(M)[:, 0]
    _refuse(lowest < -1e-5 * largest, ids, "information is indefinite.")
