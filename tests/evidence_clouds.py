"""Clouds of floors and boxes, and who tells how they fit."""

import jax.numpy as jnp
import numpy as np

from jaxreg.cloud import PointCloud
from jaxreg.matching import Witness
from jaxreg.neighbours import BruteForce


SPACING = 0.1
EYE = jnp.eye(4)
UP = np.tile([0.0, 0.0, 1.0], (256, 1))


def as_cloud(points: np.ndarray, normals: np.ndarray) -> PointCloud:
    """In float32, all valid."""
    return PointCloud(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(normals, jnp.float32),
        jnp.ones(len(points), bool),
    )


def floor(height: float, shift: float = 0.0) -> np.ndarray:
    """16 x 16 points a spacing apart, moved up and along x."""
    x, y = np.meshgrid(np.arange(16), np.arange(16))
    points = SPACING * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return points + [shift, 0.03, height]


def witness(source: PointCloud, target: PointCloud) -> Witness:
    """Of two clouds, by comparing all pairs."""
    indexes = (BruteForce.build(x.points, x.mask) for x in (source, target))
    return Witness.of(source, target, *indexes)
