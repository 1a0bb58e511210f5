"""Which target point each source point falls on at a pose."""

import equinox as eqx
from jaxtyping import Array

from jaxreg._core.checks import as_float_array, check_motion, check_pair
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.geometry import lie
from jaxreg.neighbours.auto import exact_index
from jaxreg.neighbours.base import Neighbours


def correspondences(
    source: ArrayLike,
    target: ArrayLike,
    T_target_source: ArrayLike,
    *,
    max_distance: float | Array | None = None,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
) -> Neighbours:
    """The closest target point of every source point under a pose, exactly.

    For the pose of any method, on all the points of one pair (`register` itself works
    on thinned clouds). Batches by `jax.vmap`.

        >>> import jax.numpy as jnp
        >>> import jaxreg as jr
        >>> source, target = [[0.0, 0.1]], [[5.0, 5.0], [0.0, 0.0]]
        >>> found = jr.correspondences(source, target, jnp.eye(3))
        >>> int(found.index[0])
        1

    Args:
        source: `(n, d)` points.
        target: `(m, d)` points of the same dtype.
        T_target_source: `(d+1, d+1)`, such as `sol.T_target_source`.
        max_distance: pairs farther apart are flagged invalid, in the unit of the
            points.
        source_mask: `(n,)` True for valid points; others are flagged invalid.
        target_mask: `(m,)` True for valid points; others are never found.

    Returns:
        `Neighbours` with `index` `(n,)` rows of the target, `sq_distance` `(n,)` and
        `valid` `(n,)`.

    Raises:
        ValueError, TypeError: while tracing, for shapes and dtypes that do not fit.

    Gradients: of `sq_distance`, with respect to both clouds and the pose.
    """
    source, target, source_mask, target_mask = check_pair(
        source, target, source_mask, target_mask
    )
    if source.ndim != 2:
        raise ValueError(
            f"source: wanted one point set (n, d), found shape {source.shape}."
        )
    T = as_float_array(T_target_source, "T_target_source").astype(source.dtype)
    if T.ndim != 2:
        raise ValueError(f"T_target_source: wanted one motion, found shape {T.shape}.")
    check_motion(T, source.shape[-1], "T_target_source")
    if max_distance is not None:  # an array: another distance compiles nothing
        max_distance = as_float_array(max_distance, "max_distance")
        if max_distance.ndim:
            raise ValueError(
                f"max_distance: wanted one number, found shape {max_distance.shape}."
            )
        max_distance = max_distance.astype(source.dtype)
    return _find(source, target, T, max_distance, source_mask, target_mask)


@kept_program
def _find(
    source: Array,
    target: Array,
    T: Array,
    max_distance: Array | None,
    source_mask: Array,
    target_mask: Array,
) -> Neighbours:
    index = exact_index(target.shape[0]).build(target, target_mask)
    found = index.query(lie.act(T, source), radius=max_distance)
    return eqx.tree_at(lambda f: f.valid, found, found.valid & source_mask)
