"""Where the scanners of a pair stood, checked: what they saw to be free is evidence."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import as_float_array, as_host_numbers, is_concrete
from jaxreg._core.platforms import platform_of
from jaxreg.registration.far import Moved


# A viewpoint lies on a point if it is nearer than this share of the scan's extent.
_ON_POINT = 1e-6
# Points or masks, with leading axes or in a list.
_Rows = Array | list[Array]


def checked_viewpoints(
    viewpoints: object,
    moved: tuple[Moved, Moved],
    clouds: tuple[_Rows, _Rows, _Rows, _Rows],
    batch: tuple[int, ...],
) -> Float[Array, "*b 2 d"] | None:
    """Of source and target, NaN where that is not known; None if of neither.

    Args:
        viewpoints: as `register` is given them.
        moved: the clouds as they were moved to their middles.
        clouds: sources, targets and the masks of both.
        batch: leading axes.

    Raises:
        TypeError, ValueError: for other shapes, for numbers that are not finite, and
            where a viewpoint is one of the points.
    """
    if viewpoints is None:
        return None
    if not isinstance(viewpoints, list | tuple) or len(viewpoints) != 2:
        raise ValueError(
            "viewpoints: wanted two, of the source and of the target, each None where "
            "it is not known."
        )
    if all(x is None for x in viewpoints):
        return None
    names = [f"viewpoints[{k}]" for k in range(2)]
    sides = zip(viewpoints, moved, clouds[:2], clouds[2:], names, strict=True)
    eyes = [_of_side(*side, batch) for side in sides]
    if all(isinstance(eye, np.ndarray) for eye in eyes):  # so that it compiles nothing
        return jax.device_put(np.stack(eyes, axis=-2))
    return jnp.stack(eyes, axis=-2)


def _of_side(
    viewpoint: object,
    moved: Moved,
    points: _Rows,
    mask: _Rows,
    name: str,
    batch: tuple[int, ...],
) -> Array | np.ndarray:
    """`(*batch, d)`, on the host if it can be read."""
    one = points[0] if isinstance(points, list) else points
    shape = (*batch, one.shape[-1])
    if viewpoint is None:
        return np.full(shape, np.nan, one.dtype)
    if moved.origin is not None:
        viewpoint = as_host_numbers(viewpoint, name)
        if viewpoint.shape in (shape, shape[-1:]):
            viewpoint = viewpoint - moved.origin
    eye = as_float_array(viewpoint, name)
    if eye.shape not in (shape, shape[-1:]):
        raise ValueError(
            f"{name}: wanted shape {shape[-1:]}"
            + f", or {shape} for each of the pairs" * bool(batch)
            + f", found {eye.shape}."
        )
    if not is_concrete(eye):
        return jnp.broadcast_to(eye.astype(one.dtype), shape)
    eye = np.broadcast_to(np.asarray(eye, one.dtype), shape)
    if _on_host(points, mask):
        host, valid = jax.tree.map(np.asarray, (points, mask))
        for index in np.ndindex(*batch):
            at = index[0] if isinstance(points, list) else index
            where = name + "".join(f"[{k}]" for k in index)
            check_viewpoint(eye[index], host[at], valid[at], where)
    return eye


def _on_host(*rows: _Rows) -> bool:
    """Whether all can be read without moving them."""
    arrays = jax.tree.leaves(rows)
    here = all(is_concrete(x) and x.is_fully_addressable for x in arrays)
    return here and platform_of(arrays) == "cpu"


def check_viewpoint(
    eye: np.ndarray, points: np.ndarray, mask: np.ndarray, name: str
) -> None:
    """Requires a finite place that is none of the points, in one scan.

    Raises:
        ValueError: otherwise; of rows that stand for missing returns it is one.
    """
    if not np.all(np.isfinite(eye)):
        raise ValueError(
            f"{name}: wanted finite numbers, found {eye.tolist()}; "
            "give None where a viewpoint is not known."
        )
    valid = np.flatnonzero(mask & np.all(np.isfinite(points), axis=1))
    if not len(valid):
        return
    distance = np.linalg.norm(points[valid] - eye, axis=1)
    row = np.argmin(distance)
    if distance[row] <= _ON_POINT * np.max(distance):
        raise ValueError(
            f"{name}: is a point of the scan, row {valid[row]}. Leave out "
            "rows that stand for missing returns."
        )
