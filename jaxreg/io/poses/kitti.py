"""Trajectories in KITTI text files: the upper 3 x 4 of a pose in each line."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import as_host_numbers, check_rigid
from jaxreg._core.typing import ArrayLike
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.rows import numbers, read_lines


def read_kitti(path: str | Path) -> Float[Array, "v 4 4"]:
    """Reads `T_world_i` of each line.

    Raises:
        InputError: for a file that cannot be read or a line that makes no sense, which
            the message names.
    """
    poses = []
    for line in read_lines(path):
        T = np.eye(4)
        T[:3] = numbers(path, line, 12, "a pose").reshape(3, 4)
        R = T[:3, :3]
        if np.abs(R.T @ R - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
            raise InputError(
                f"{path}, line {line[0]}: the rotation is not orthonormal within 0.01 "
                "or is a reflection."
            )
        poses.append(T)
    if not poses:
        raise InputError(f"{path}: holds no poses.")
    return jnp.asarray(np.stack(poses), dtype=jnp.result_type(float))


def write_kitti(path: str | Path, T_world_i: ArrayLike) -> None:
    """Writes poses; the file appears whole or not at all.

    Args:
        path: the file to write.
        T_world_i: `(v, 4, 4)` poses.

    Raises:
        ValueError: for wrong shapes.
        InputError: if the folder cannot be written.
    """
    T = as_host_numbers(T_world_i, "T_world_i")
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise ValueError(f"T_world_i: wanted shape (v, 4, 4), found {T.shape}.")
    check_rigid(T, "T_world_i")
    with atomic_write(path) as file:
        for row in T[:, :3].reshape(-1, 12):
            file.write(" ".join(f"{x:.17g}" for x in row) + "\n")
