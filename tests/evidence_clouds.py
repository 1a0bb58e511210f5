"""Clouds of floors and boxes, and who tells how they fit."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.cloud import PointCloud, thin
from jaxreg.matching import Evidence, Witness
from jaxreg.neighbours import BruteForce


SPACING = 0.1
EYE = jnp.asarray(np.eye(4, dtype=np.float32))
#: More than any of these clouds has points.
ROWS = 400
UP = np.tile([0.0, 0.0, 1.0], (256, 1))


def as_cloud(points: np.ndarray, normals: np.ndarray, rows: int = ROWS) -> PointCloud:
    """In float32; masked rows behind, `rows` in all, so that sizes share programs."""
    behind = ((0, rows - len(points)), (0, 0))
    return PointCloud(
        jnp.asarray(np.pad(points, behind).astype(np.float32)),
        jnp.asarray(np.pad(normals, behind).astype(np.float32)),
        jnp.asarray(np.arange(rows) < len(points)),
    )


_thin = jax.jit(thin, static_argnames=("capacity", "num_neighbours"))


def thinned(points: np.ndarray, capacity: int, rows: int) -> PointCloud:
    """With normals from ten neighbours; of `(n, 3)` points, padded to `rows`."""
    padded = np.pad(points, ((0, rows - len(points)), (0, 0)))
    mask = jnp.asarray(np.arange(rows) < len(points))
    return _thin(jnp.asarray(padded), mask, capacity, 10)


def floor(height: float, shift: float = 0.0) -> np.ndarray:
    """16 x 16 points a spacing apart, moved up and along x."""
    x, y = np.meshgrid(np.arange(16), np.arange(16))
    points = SPACING * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return points + [shift, 0.03, height]


def witness(source: PointCloud, target: PointCloud) -> Witness:
    """Of two clouds, by comparing all pairs."""
    indexes = (BruteForce.build(x.points, x.mask) for x in (source, target))
    return Witness.of(source, target, *indexes)


@jax.jit
def evidence(source: PointCloud, target: PointCloud, T: jax.Array) -> Evidence:
    """Of one pose, as one program."""
    return witness(source, target).of_pose(T)
