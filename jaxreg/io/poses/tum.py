"""Trajectories in TUM text files: `timestamp tx ty tz qx qy qz qw`, one pose a line."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import as_host_numbers, check_rigid
from jaxreg._core.typing import ArrayLike
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.files import text_lines
from jaxreg.io.quaternions import motions_from_xyzw, xyzw_from_rotations


def write_tum(
    path: str | Path,
    T_world_i: ArrayLike,
    timestamps: ArrayLike | None = None,
) -> None:
    """Writes poses as a trajectory; the file appears whole or not at all.

    Args:
        path: the file to write.
        T_world_i: `(v, d+1, d+1)` poses; 2D poses are written in the plane z = 0.
        timestamps: `(v,)` seconds, or None for 0, 1, 2, ...

    Raises:
        ValueError: for wrong shapes.
        InputError: if the folder cannot be written.
    """
    T = as_host_numbers(T_world_i, "T_world_i")
    if T.ndim != 3 or T.shape[1:] not in ((3, 3), (4, 4)):
        raise ValueError(
            f"T_world_i: wanted shape (v, 3, 3) or (v, 4, 4), found {T.shape}."
        )
    check_rigid(T, "T_world_i")
    times = np.arange(len(T)) if timestamps is None else timestamps
    times = as_host_numbers(times, "timestamps")
    if times.shape != (len(T),):
        raise ValueError(f"timestamps: wanted shape {(len(T),)}, found {times.shape}.")
    if not np.isfinite(times).all():
        raise ValueError("timestamps: wanted finite numbers.")
    if T.shape[1] == 3:
        flat, T = T, np.tile(np.eye(4), (len(T), 1, 1))
        T[:, :2, :2], T[:, :2, 3] = flat[:, :2, :2], flat[:, :2, 2]
    rows = np.concatenate(
        [times[:, None], T[:, :3, 3], xyzw_from_rotations(T[:, :3, :3])], axis=1
    )
    with atomic_write(path) as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        file.writelines(" ".join(f"{x:.17g}" for x in row) + "\n" for row in rows)


def read_tum(path: str | Path) -> tuple[np.ndarray, Float[Array, "v 4 4"]]:
    """Reads a trajectory.

    Returns:
        `(v,)` timestamps in float64 and `(v, 4, 4)` poses.

    Raises:
        InputError: for a file that cannot be read or a line that makes no sense, which
            the message names.
    """
    rows = []
    for number, line in text_lines(path):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = np.array(words, dtype=np.float64)
        except ValueError:
            raise InputError(f"{path}, line {number}: not numbers alone.") from None
        if len(row) != 8 or not np.isfinite(row).all():
            raise InputError(
                f"{path}, line {number}: wanted 8 finite numbers (timestamp, position, "
                f"quaternion xyzw), found {line.strip()!r}."
            )
        if np.linalg.norm(row[4:]) < 1e-6:
            raise InputError(f"{path}, line {number}: the quaternion is zero.")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: holds no poses.")
    table = np.stack(rows)
    poses = motions_from_xyzw(table[:, 1:4], table[:, 4:])
    return table[:, 0], jnp.asarray(poses, dtype=jnp.result_type(float))
