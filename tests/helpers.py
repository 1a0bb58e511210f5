"""Generators and paths that several tests share."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def data_dir(*parts: str) -> Path:
    """A folder or file of the real data; skips the test where it is absent."""
    import pytest  # not where the comparison with other libraries draws from here

    root = Path(
        os.environ.get(
            "JAXREG_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"
        )
    )
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real data not found: {'/'.join(parts)} (set JAXREG_DATA)")
    return path


@contextmanager
def compiled() -> Iterator[list[str]]:
    """Names of functions, as they are compiled meanwhile."""
    import jax

    names: list[str] = []

    def hear(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.endswith("backend_compile_duration"):
            names.append(str(kwargs["fun_name"]))

    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(hear)


@contextmanager
def switched_on(*names: str, to: bool = True) -> Iterator[None]:
    """With settings of JAX that are off by default, or off with `to=False`."""
    import jax

    before = {name: jax.config.values[name] for name in names}
    for name in names:
        jax.config.update(name, to)
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def blob(n: int, d: int, seed: int = 0) -> np.ndarray:
    """`(n, d)` points on an asymmetric closed curve (2D) or surface (3D) of size 1."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, d))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    waves = np.array([[2.0, 1.0, 0.5], [-1.0, 2.5, 1.5], [0.5, -1.5, 3.0]])[:, :d]
    radius = 1 + 0.25 * np.sin(x @ waves.T + [0.3, 1.1, 2.0]) @ [1.0, 0.8, 0.6]
    return (radius[:, None] * x).astype(np.float32)


def half_noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Half of the points replaced by uniform ones in their bounding box."""
    rng = np.random.default_rng(seed)
    out, rows = points.copy(), rng.permutation(len(points))[: len(points) // 2]
    size = (len(rows), points.shape[1])
    out[rows] = rng.uniform(points.min(0), points.max(0), size)
    return out


def motion(seed: int, d: int, angle: float | None = None, shift: float = 1.0):
    """A random rigid motion `(d+1, d+1)`, float64; `angle` in radians, None: any."""
    rng = np.random.default_rng(seed)
    T = np.eye(d + 1)
    turn = rng.uniform(-np.pi, np.pi) if angle is None else angle
    if d == 2:
        c, s = np.cos(turn), np.sin(turn)
        T[:2, :2] = [[c, -s], [s, c]]
    else:
        axis = rng.standard_normal(3)
        vector = turn * axis / np.linalg.norm(axis)
        R = Rotation.random(rng=rng) if angle is None else Rotation.from_rotvec(vector)
        T[:3, :3] = R.as_matrix()
    T[:d, d] = shift * rng.standard_normal(d)
    return T


def move(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Applies a motion, in the dtype of the points."""
    d = points.shape[1]
    return (points @ T[:d, :d].T + T[:d, d]).astype(points.dtype)


def pose_error(T, T_true) -> tuple[float, float]:
    """Rotation angle in radians and translation distance between two motions."""
    delta = np.linalg.inv(np.asarray(T_true, float)) @ np.asarray(T, float)
    d = len(delta) - 1
    if d == 2:
        angle = abs(np.arctan2(delta[1, 0], delta[0, 0]))
    else:
        angle = Rotation.from_matrix(delta[:3, :3]).magnitude()
    return float(angle), float(np.linalg.norm(delta[:d, d]))
