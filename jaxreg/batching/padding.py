"""Point sets of unequal sizes: lists of them, and arrays of few sizes with masks."""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxreg._core.checks import (
    as_float_array,
    check_mask,
    held_points,
    is_concrete,
)


Tree = TypeVar("Tree")

_LEAST = 64


def rounded_up(num_rows: int, least: int = _LEAST, an_octave: int = 4) -> int:
    """The smallest size of 64, 80, 96, 112, 128, 160, ... that holds so many rows.

    `least` is the first of them, a power of two of at least 4. Four sizes an octave, so
    that few programs compile: a quarter more rows at most, a ninth on average. With two
    half more at most, a fifth on average; with one twice as many at most.
    """
    if num_rows <= least:
        return least
    step = (1 << (num_rows - 1).bit_length()) // (2 * an_octave)
    return -(-num_rows // step) * step


def is_list_of_clouds(x: object) -> bool:
    """A list or tuple whose first item is a matrix; rows of numbers are one cloud."""
    if not isinstance(x, list | tuple) or not x:
        return False
    try:
        return np.ndim(held_points(x[0])) == 2
    except ValueError:  # not rectangular
        return False


def check_lists(
    source: object, target: object, source_mask: object, target_mask: object
) -> tuple[list[Array], list[Array], list[Array], list[Array]]:
    """Lists of `(n_i, d)` and `(m_i, d)` points, n_i and m_i may be 0, and masks."""
    sources, targets = _clouds(source, "source"), _clouds(target, "target")
    if len(sources) != len(targets):
        raise ValueError(
            "source and target: wanted lists of the same length, found "
            f"{len(sources)} and {len(targets)} point sets."
        )
    first, other = sources[0], targets[0]
    if other.shape[1] != first.shape[1]:
        raise ValueError(
            f"target[0]: wanted points of dimension {first.shape[1]} like source[0], "
            f"found shape {other.shape}."
        )
    if other.dtype != first.dtype:
        raise TypeError(
            f"target[0]: wanted dtype {first.dtype} like source[0], found "
            f"{other.dtype}."
        )
    source_masks = _masks(source_mask, sources, "source_mask")
    return sources, targets, source_masks, _masks(target_mask, targets, "target_mask")


def _clouds(clouds: object, name: str) -> list[Array]:
    if not isinstance(clouds, list | tuple):
        raise TypeError(
            f"{name}: wanted a list of point sets like the other one, found "
            f"{type(clouds).__name__}; repeat what the pairs share."
        )
    arrays = [as_float_array(x, f"{name}[{i}]") for i, x in enumerate(clouds)]
    for i, x in enumerate(arrays):
        first = arrays[0]
        if x.ndim != 2 or x.shape[1] not in (2, 3) or x.shape[1] != first.shape[1]:
            wanted = "(n, 2) or (n, 3)" if i == 0 else f"(n, {first.shape[1]})"
            raise ValueError(f"{name}[{i}]: wanted shape {wanted}, found {x.shape}.")
        if x.dtype != first.dtype:
            raise TypeError(
                f"{name}[{i}]: wanted dtype {first.dtype} like {name}[0], found "
                f"{x.dtype}."
            )
    return arrays


def _masks(masks: object, clouds: list[Array], name: str) -> list[Array]:
    if masks is None:
        masks = [None] * len(clouds)
    if not isinstance(masks, list | tuple) or len(masks) != len(clouds):
        found = len(masks) if isinstance(masks, list | tuple) else type(masks).__name__
        raise ValueError(f"{name}: wanted a list of {len(clouds)}, found {found}.")
    # Made on the host: another length compiles nothing.
    return [
        check_mask(
            np.ones(len(x), bool) if mask is None else mask, (len(x),), f"{name}[{i}]"
        )
        for i, (mask, x) in enumerate(zip(masks, clouds, strict=True))
    ]


def stacked(arrays: Sequence[Array], num_rows: int) -> Array:
    """`(v, num_rows, ...)` from arrays `(n_i, ...)`: zero, or False, behind each."""
    shape = (len(arrays), num_rows, *arrays[0].shape[1:])
    if all(map(is_concrete, arrays)):  # on the host, for the same reason
        out = np.zeros(shape, arrays[0].dtype)
        for row, x in zip(out, arrays, strict=True):
            row[: len(x)] = x
        return jax.device_put(out)
    out = jnp.zeros(shape, arrays[0].dtype)
    for i, x in enumerate(arrays):
        out = out.at[i, : len(x)].set(x)
    return out


def lengthened(x: Array | np.ndarray, num_rows: int) -> Array:
    """A concrete array with rows of zero, or False, behind its own."""
    out = np.zeros((num_rows, *x.shape[1:]), x.dtype)
    out[: len(x)] = x
    return jax.device_put(out)


def unstacked(tree: Tree, num: int) -> list[Tree]:
    """A tree for each of the `num` rows of all arrays of a tree."""
    if all(map(is_concrete, jax.tree.leaves(tree))):  # so that it compiles nothing
        host = jax.tree.map(np.asarray, tree)
        return jax.device_put([_row(host, k) for k in range(num)])
    return [_row(tree, k) for k in range(num)]


def _row(tree: Tree, k: int) -> Tree:
    return jax.tree.map(lambda x: x[k], tree)
