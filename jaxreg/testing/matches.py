"""Matches of small clouds, whose points are paired by their rows."""

import jax.numpy as jnp
import numpy as np

from jaxreg.cloud import PointCloud
from jaxreg.matching import Match, Problem, match
from jaxreg.neighbours import BruteForce
from jaxreg.testing.problems import NUM_POINTS, motion, move, surface


def matched(
    source: np.ndarray, target: np.ndarray, normals: np.ndarray, T: np.ndarray
) -> Match:
    """Point i of the source with point i of the target; normals are of both."""
    dtype, everyone = source.dtype, jnp.ones(len(source), bool)
    here, there = (
        PointCloud(jnp.asarray(x), jnp.asarray(n.astype(dtype)), everyone)
        for x, n in zip((source, target), normals, strict=True)
    )
    problem = Problem.of(here, there, BruteForce.build(there.points, everyone))
    rows = jnp.arange(len(source), dtype=jnp.int32)
    return match(problem, jnp.asarray(T.astype(dtype)), rows)


def random_normals(d: int, seed: int = 0) -> np.ndarray:
    """Of both clouds, `(2, n, d)`, random."""
    normals = np.random.default_rng(seed).standard_normal((2, NUM_POINTS, d))
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def noisy_match(
    d: int, dtype: type = np.float64, turn: np.ndarray | None = None
) -> tuple[Match, np.ndarray]:
    """A match of which nothing vanishes, and its pose; both clouds turned likewise."""
    T, G = motion(d, 0.1, 0.05, 2), np.eye(d + 1) if turn is None else turn
    source = surface(NUM_POINTS, d)
    noise = 0.1 * np.random.default_rng(3).standard_normal(source.shape)
    target = move(motion(d, 0.2, 0.1, 1), source) + noise
    source, target = (move(G, x).astype(dtype) for x in (source, target))
    T = G @ T @ np.linalg.inv(G)
    return matched(source, target, random_normals(d) @ G[:d, :d].T, T), T
