"""The table of all public methods, and small problems to run them on.

A row says how to make the method and what its docstring promises of gradients. Settings
are small: compiling is what the tests cost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from averaging.graphs import random_graph
from helpers import blob, motion, move

import jaxreg as jr
from jaxreg.averaging import CycleConsensus
from jaxreg.neighbours import AbstractIndex


NUM_POINTS = 48
NUM_POSES, NUM_EDGES = 5, 10  # all pairs
KEY = jax.random.key(0)


@dataclass(frozen=True)
class Row:
    """A method by dimension, and its slopes.

    Exact; exact where kernel widths do not change; or zero, where they are cut.
    """

    make: Callable[[int], Any]
    slopes: Literal["exact", "at held widths", "zero"]


_SEARCH: dict[str, Any] = {
    "num_points": NUM_POINTS,
    "num_modes": 2,
    "max_points": NUM_POINTS,
    "batch_size": 16,
}
#: Methods of `register`.
REGISTRARS = {
    "ICP": Row(
        lambda d: jr.ICP(jr.PointToPoint(), tolerance=1e-13, width_end=3.0), "exact"
    ),
    "KernelCorrelation": Row(lambda d: jr.KernelCorrelation(0.25), "exact"),
    "ParticleFilter": Row(
        lambda d: jr.ParticleFilter(
            num_prior=16, num_particles=8, num_times=2, **_SEARCH
        ),
        "zero",
    ),
    "MultiStart": Row(
        lambda d: jr.MultiStart(num_starts=16, num_steps=8, **_SEARCH), "zero"
    ),
    "sandhu2010": Row(
        lambda d: jr.sandhu2010(d, 8, num_times=2, num_points=NUM_POINTS), "zero"
    ),
}
#: Methods of `average`.
AVERAGERS = {
    "SpanningTree": Row(lambda d: jr.SpanningTree(), "zero"),
    "ShortestPaths": Row(lambda d: jr.ShortestPaths(), "zero"),
    "CycleConsensus": Row(lambda d: CycleConsensus(), "zero"),
    "LowRankSparse": Row(lambda d: jr.LowRankSparse(), "zero"),
    "MotionAveraging": Row(lambda d: jr.MotionAveraging(tolerance=1e-13), "exact"),
    "WeightedMotionAveraging": Row(
        lambda d: jr.WeightedMotionAveraging(tolerance=1e-13), "exact"
    ),
    "Correntropy": Row(lambda d: jr.Correntropy(tolerance=1e-13), "at held widths"),
    "MCC": Row(
        lambda d: jr.MCC(tolerance=1e-13, max_steps=400, initialiser=jr.SpanningTree()),
        "exact",
    ),
    "PoseGraphLM": Row(lambda d: jr.PoseGraphLM(tolerance=1e-15), "exact"),
}
#: Indexes of closest points, as functions of targets.
INDEXES: dict[type[AbstractIndex], dict[str, Any]] = {
    jr.BruteForce: {},
    jr.BoxTree: {},
    jr.VoxelTable: {"resolution": 8},
    jr.CellGrid: {"radius": 0.5},
}
#: Public functions: the three verbs, and those that need no method.
FUNCTIONS = {
    "register",
    "average",
    "reconstruct",
    "correspondences",
    "pose_covariances",
    "sandhu2010",
}


def pair(d: int, dtype: type, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Two noisy samples of a closed surface, some degrees apart."""
    rng = np.random.default_rng(seed)
    source = blob(NUM_POINTS, d, seed).astype(float)
    noise = 0.05 * rng.standard_normal(source.shape)
    target = move(motion(seed, d, angle=0.15, shift=0.05), source + noise)
    return jnp.asarray(source, dtype), jnp.asarray(target, dtype)


def scans(d: int, dtype: type, seed: int = 0) -> jax.Array:
    """Three samples of a closed surface, some degrees apart."""
    poses = [motion(10 * seed + i, d, angle=0.3, shift=0.1) for i in range(3)]
    samples = [blob(NUM_POINTS, d, i).astype(float) for i in range(3)]
    moved = [move(T, x) for T, x in zip(poses, samples, strict=True)]
    return jnp.asarray(np.stack(moved), dtype)


def pair_changes(d: int, dtype: type) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each source point its own way; the target as a whole, which keeps its spacing."""
    rng = np.random.default_rng(1)
    source, target = (np.asarray(x) for x in pair(d, dtype))
    turn = rng.standard_normal((d, d))
    carried = target @ (turn - turn.T) + rng.standard_normal(d)
    apart = rng.standard_normal(source.shape)
    return [(apart, 0 * target), (0 * source, carried)]


def measured(d: int, dtype: type, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Motions of a graph, and their weights."""
    T = random_graph(NUM_POSES, NUM_EDGES, 0.0, seed, d=d, noise=4.0)[2]
    weight = np.random.default_rng(seed).uniform(0.5, 1.5, NUM_EDGES)
    return jnp.asarray(T, dtype), jnp.asarray(weight, dtype)


def graph(T_i_j: jax.Array, weight: jax.Array) -> jr.PoseGraph:
    """The graph of those motions."""
    edges = np.stack(np.triu_indices(NUM_POSES, 1), axis=1)
    return jr.PoseGraph.from_edges(edges, T_i_j, NUM_POSES, weight)


def _skew(rng: np.random.Generator, num: int, d: int) -> np.ndarray:
    turn = rng.standard_normal((num, d, d))
    return turn - turn.swapaxes(1, 2)


def measured_changes(d: int, dtype: type) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of the motions, keeping the lengths; of the weights."""
    rng = np.random.default_rng(1)
    T, weight = (np.asarray(x) for x in measured(d, dtype))
    turn = _skew(rng, NUM_EDGES, d)
    change = np.zeros_like(T)
    change[:, :d, :d] = T[:, :d, :d] @ turn
    change[:, :d, d] = np.einsum("eij,ej->ei", turn, T[:, :d, d])
    return [(change, 0 * weight), (0 * T, 5 * rng.standard_normal(NUM_EDGES))]


def turned_frames(d: int, dtype: type) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of the motions, as if every frame were turned: all residuals stay."""
    T, weight = (np.asarray(x) for x in measured(d, dtype))
    turn = np.zeros((NUM_POSES, d + 1, d + 1))
    turn[:, :d, :d] = _skew(np.random.default_rng(1), NUM_POSES, d)
    i, j = np.triu_indices(NUM_POSES, 1)
    return [(T @ turn[j] - turn[i] @ T, 0 * weight)]
