"""Matches with known correspondences that the tests of this folder share."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import blob, motion, move
from numpy.typing import DTypeLike
from scipy.spatial import KDTree

from jaxreg.cloud import PointCloud
from jaxreg.matching import Problem, match
from jaxreg.neighbours import BruteForce


N = 60
found_at = jax.jit(match)


class RowByRow(BruteForce):
    """Point i of the source belongs to point i of the target."""

    def lookup(self, columns, num=None, coarse=None):
        return jnp.arange(columns.shape[1], dtype=jnp.int32)


def normals_of(points: np.ndarray) -> np.ndarray:
    """Unit normals of either sign from the eight closest points."""
    rows = KDTree(points).query(points, 8)[1]
    around = points[rows] - points[rows].mean(axis=1, keepdims=True)
    normals = np.linalg.svd(around, full_matrices=False)[2][:, -1]
    return normals.astype(points.dtype)


def problem_of(
    source, source_normals, target, target_normals, index: type[BruteForce] = RowByRow
):
    """The problem of NumPy arrays; row by row unless another index is given."""
    source, source_normals, target, target_normals = map(
        jnp.asarray, (source, source_normals, target, target_normals)
    )
    return Problem.of(
        PointCloud(source, source_normals, jnp.ones(len(source), bool)),
        PointCloud(target, target_normals, jnp.ones(len(target), bool)),
        index.build(target),
    )


def noisy_problem(d: int, dtype: DTypeLike = np.float64):
    """A problem whose normals are random and residuals large, and a pose and weights.

    Nothing in it vanishes by accident.
    """
    rng = np.random.default_rng(0)
    source = blob(N, d).astype(dtype)
    source -= source.mean(0)
    target = move(motion(1, d, angle=0.2, shift=0.1), source)
    target += 0.1 * rng.standard_normal((N, d)).astype(dtype)
    normals = rng.standard_normal((2, N, d))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    problem = problem_of(
        source, normals[0].astype(dtype), target, normals[1].astype(dtype)
    )
    T = jnp.asarray(motion(2, d, angle=0.1, shift=0.05).astype(dtype))
    return problem, T, jnp.asarray(rng.uniform(0.1, 1, N).astype(dtype))
