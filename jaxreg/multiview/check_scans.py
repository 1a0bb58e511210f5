"""What `reconstruct` takes, checked and padded."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg._core.checks import (
    as_float_array,
    check_mask,
    check_points,
    is_concrete,
)
from jaxreg.batching.padding import rounded_up, stacked
from jaxreg.registration.viewpoints import check_viewpoint


# Scans are thinned to some thousand points; of very large ones so many are enough.
_MOST_POINTS = 1 << 19
_WORDS = {1: "one or more", 2: "two or more"}


def padded_scans(
    scans: object, mask: object, *, least: int = 2, num_rows: int | None = None
) -> tuple[Array, Array]:
    """Scans as `(v, n, d)` with a mask; points of very large ones in a list drawn.

    Args:
        scans: as in `reconstruct`.
        mask: as there.
        least: how many scans are wanted.
        num_rows: of the points of a scan in a list; None for what they need.
    """
    if isinstance(scans, Sequence):
        if mask is not None:
            raise ValueError("mask: only for a padded array, not for a list of scans.")
        arrays = [as_float_array(x, f"scans[{i}]") for i, x in enumerate(scans)]
        for i, x in enumerate(arrays):
            check_points(x, f"scans[{i}]")
            if x.ndim != 2 or x.shape[1] != arrays[0].shape[1]:
                raise ValueError(
                    f"scans[{i}]: wanted shape (n, {arrays[0].shape[-1]}) like "
                    f"scans[0], found {x.shape}."
                )
        if len(arrays) < least:
            raise ValueError(f"scans: wanted {_WORDS[least]}, found {len(arrays)}.")
        arrays = [_drawn(x, num_rows or _MOST_POINTS) for x in arrays]
        dtype = jnp.result_type(*arrays)
        lengths = np.array([len(x) for x in arrays])
        rows = num_rows or rounded_up(max(lengths.tolist()))
        row_mask = jax.device_put(np.arange(rows) < lengths[:, None])
        return stacked([x.astype(dtype) for x in arrays], rows), row_mask
    points = as_float_array(scans, "scans")
    check_points(points, "scans")
    if points.ndim != 3 or points.shape[0] < least:
        raise ValueError(
            f"scans: wanted a list of {_WORDS[least]} (n, d) arrays or a padded array "
            f"(v, n, d), found shape {points.shape}."
        )
    return points, check_mask(mask, points.shape[:2], "mask")


def _drawn(points: Float[Array, "n d"], most: int) -> Float[Array, "m d"]:
    """All points, or as many at random as are enough; the same ones every time."""
    n = len(points)
    if n <= most:
        return points
    return points[np.sort(np.random.default_rng(n).permutation(n)[:most])]


def checked_viewpoints(
    viewpoints: object, points: Float[Array, "v n d"], mask: Bool[Array, "v n"]
) -> Float[Array, "v d"] | None:
    """Where the scanners stood, NaN where that is not known; None if of no scan.

    Raises:
        ValueError: for another shape, for numbers that are not finite, and where a
            viewpoint is one of the points, as of rows that stand for missing returns.
    """
    if viewpoints is None:
        return None
    num, _, d = points.shape
    if isinstance(viewpoints, Sequence):
        unknown = np.array([x is None for x in viewpoints], bool)
        rows = [
            jnp.zeros(d) if x is None else as_float_array(x, f"viewpoints[{i}]")
            for i, x in enumerate(viewpoints)
        ]
        for i, x in enumerate(rows):
            if x.shape != (d,):
                raise ValueError(
                    f"viewpoints[{i}]: wanted shape ({d},) or None, found {x.shape}."
                )
        eyes = jnp.stack(rows) if rows else jnp.zeros((0, d))
    else:
        eyes = as_float_array(viewpoints, "viewpoints")
        unknown = np.zeros(len(eyes) if eyes.ndim else 0, bool)
    if eyes.shape != (num, d):
        raise ValueError(
            f"viewpoints: wanted one of shape ({d},) for each of {num} scans, found "
            f"shape {eyes.shape}."
        )
    if is_concrete(eyes) and is_concrete(points) and is_concrete(mask):
        host = np.asarray(eyes), np.asarray(points), np.asarray(mask)
        for i in np.flatnonzero(~unknown):
            check_viewpoint(host[0][i], host[1][i], host[2][i], f"viewpoints[{i}]")
    return jnp.where(unknown[:, None], jnp.nan, eyes.astype(points.dtype))
