"""Poses compared after one displacement that all published ones share is taken out.

Poses of scans from a turntable come from its angles and one calibration of its axis in
the frame of the scanner. An error of the latter is one motion D in the scanner's frame
at every angle: T_true_i D for T_true_i, which no common motion of the world takes
out.
"""

import jax.numpy as jnp
import numpy as np

from jaxreg.geometry import lie


def without_displacement(T_world_i: np.ndarray, T_true_i: np.ndarray) -> np.ndarray:
    """True poses, moved in the world and displaced in their frames to fit best.

    Least squares of the right tangents, with a radian as long as the spread of the
    poses, by Gauss and Newton.

    Args:
        T_world_i: `(v, 4, 4)` poses that were found.
        T_true_i: `(v, 4, 4)` published ones.
    """
    T, fitted = np.asarray(T_world_i, np.float64), np.asarray(T_true_i, np.float64)
    spread = T[:, :3, 3] - T[:, :3, 3].mean(axis=0)
    unit = np.repeat([1 / max(np.sqrt(np.mean(spread**2)), 1e-12), 1.0], 3)
    for _ in range(5):
        error = _tangent(np.linalg.inv(fitted) @ T)
        by_world = _adjoint(np.linalg.inv(fitted))
        J = np.concatenate([by_world, np.tile(np.eye(6), (len(T), 1, 1))], axis=2)
        rows, values = (unit[:, None] * J).reshape(-1, 12), (unit * error).reshape(-1)
        step = np.linalg.lstsq(rows, values, rcond=None)[0]
        fitted = _motion(step[:6]) @ fitted @ _motion(step[6:])
    return fitted


def _tangent(T: np.ndarray) -> np.ndarray:
    return np.asarray(lie.log(jnp.asarray(T)), np.float64)


def _adjoint(T: np.ndarray) -> np.ndarray:
    return np.asarray(lie.adjoint(jnp.asarray(T)), np.float64)


def _motion(tangent: np.ndarray) -> np.ndarray:
    return np.asarray(lie.exp(jnp.asarray(tangent)), np.float64)
