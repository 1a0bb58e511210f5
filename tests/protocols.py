"""The table of all public methods and parts, with what their docstrings promise.

And small problems to run them on.

Settings are small: compiling is what the tests cost.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

import jaxreg as jr
from jaxreg import particle, robust
from jaxreg.averaging import CycleConsensus
from jaxreg.testing import problems
from jaxreg.testing.problems import EDGES, NUM_POINTS, NUM_POSES


KEY = jax.random.key(0)


@dataclass(frozen=True)
class Row:
    """A method by dimension, and the promises that its check is told of."""

    make: Callable[[int], Any]
    promises: dict[str, Any] = field(default_factory=dict)


_SEARCH: dict[str, Any] = {
    "num_points": NUM_POINTS,
    "num_modes": 2,
    "max_points": NUM_POINTS,
    "batch_size": 16,
}
_EXACT, _REFUSED = {"gradients": "exact"}, {"gradients": "refused"}
_SEARCHES = {"gradients": "exact", "draws": True}
#: Methods of `register`; all but those that refuse may be differentiated by the clouds,
#: and `by` names the numbers of theirs that have an influence.
REGISTRARS = {
    "ICP": Row(
        lambda d: jr.ICP(jr.PointToPoint(), tolerance=1e-13, width_end=3.0),
        {**_EXACT, "by": ["width_end"]},
    ),
    "KernelCorrelation": Row(
        lambda d: jr.KernelCorrelation(0.25, tolerance=1e-9),
        {**_EXACT, "by": ["bandwidth"], "lengths": True},
    ),
    "KernelCorrelation by optimistix": Row(
        lambda d: jr.KernelCorrelation(
            0.25, 200, solver=optimistix.LevenbergMarquardt(1e-12, 1e-12)
        ),
        {**_EXACT, "by": ["bandwidth"], "lengths": True},
    ),
    "ParticleFilter": Row(
        lambda d: jr.ParticleFilter(
            num_prior=16, num_particles=8, num_times=2, **_SEARCH
        ),
        _SEARCHES,
    ),
    "MultiStart": Row(
        lambda d: jr.MultiStart(num_starts=16, num_steps=8, **_SEARCH), _SEARCHES
    ),
    "sandhu2010": Row(
        lambda d: jr.sandhu2010(d, 8, num_times=2, num_points=NUM_POINTS),
        {"gradients": "refused", "draws": True},
    ),
}
#: Methods of `average`.
AVERAGERS = {
    "SpanningTree": Row(lambda d: jr.SpanningTree(), _REFUSED),
    "ShortestPaths": Row(lambda d: jr.ShortestPaths(), _REFUSED),
    "CycleConsensus": Row(lambda d: CycleConsensus(), _REFUSED),
    "LowRankSparse": Row(lambda d: jr.LowRankSparse(), _REFUSED),
    "MotionAveraging": Row(lambda d: jr.MotionAveraging(tolerance=1e-13), _EXACT),
    "WeightedMotionAveraging": Row(
        lambda d: jr.WeightedMotionAveraging(tolerance=1e-13), _EXACT
    ),
    "Correntropy": Row(lambda d: jr.Correntropy(tolerance=1e-13), _EXACT),
    "MCC": Row(
        lambda d: jr.MCC(tolerance=1e-13, max_steps=400, initialiser=jr.SpanningTree()),
        _EXACT,
    ),
    "PoseGraphLM": Row(
        lambda d: jr.PoseGraphLM(tolerance=1e-15), {**_EXACT, "lengths": True}
    ),
    "RiemannianStaircase": Row(
        lambda d: jr.RiemannianStaircase(tolerance=1e-15), {**_EXACT, "lengths": True}
    ),
    "PoseGraphLM by optimistix": Row(
        lambda d: jr.PoseGraphLM(
            tolerance=1e-9, solver=optimistix.LevenbergMarquardt(1e-12, 1e-12)
        ),
        {**_EXACT, "lengths": True},
    ),
}
#: Indexes of closest points.
INDEXES = {
    jr.BruteForce: Row(lambda d: jr.BruteForce.build, {"k": 7}),
    jr.BoxTree: Row(lambda d: jr.BoxTree.build, {"k": 7}),
    jr.VoxelTable: Row(
        lambda d: partial(jr.VoxelTable.build, resolution=16, candidates=8),
        {"recall": 0.9},
    ),
    jr.CellGrid: Row(lambda d: partial(jr.CellGrid.build, radius=0.1)),
}
RESIDUALS = [
    jr.PointToPoint(),
    jr.PointToPlane(0.25),
    jr.PlaneToPlane(1 / 128),
    jr.Symmetric(),
]
KERNELS = [
    robust.L1(),
    robust.L2(),
    robust.Cauchy(),
    robust.GemanMcClure(),
    robust.Huber(),
    robust.Trimmed(),
    robust.Tukey(),
    robust.Welsch(),
]
RESAMPLERS = [
    particle.Multinomial(),
    particle.Residual(1.0),
    particle.Soft(alpha=0.5, threshold=0.7),
    particle.Stratified(),
    particle.Systematic(0.3),
    particle.Transport(),
]
#: Steps, and the residual that they are tried with.
STEPS: list[tuple[jr.AbstractStep, jr.AbstractResidual]] = [
    (jr.ClosedForm(), jr.PointToPoint()),
    (jr.GaussNewton(), jr.Symmetric()),
    (jr.GradientDescent(), jr.PointToPlane()),
    (jr.LevenbergMarquardt(), jr.PlaneToPlane()),
    (jr.OptimistixStep(optimistix.BFGS(1e-9, 1e-9)), jr.PlaneToPlane()),
]
DYNAMICS = [
    particle.NoDynamics(),
    particle.ConstantVelocity(),
    particle.StochasticDynamics(),
    particle.StochasticDynamics(0.5, particle.EnsembleSpread()),
    particle.StochasticDynamics(spread=particle.PathSpread()),
    particle.StochasticDynamics(spread=particle.MeasuredSpread()),
]
ENERGIES = [
    particle.AbsoluteEnergy(),
    particle.BoundedEnergy(),
    particle.SquaredEnergy(),
]
#: Priors, and how many poses they are asked for.
PRIORS = [
    (particle.GaussianPrior(), 8),
    (particle.GivenParticles(problems.poses(3)), NUM_POSES),
    (particle.PartialPose(up=(0, 0, 1), position=(0.5, 0.1, 0.2)), 8),
    (particle.UniformPrior(), 8),
]
#: Public functions: the three verbs, and those that need no method.
FUNCTIONS = {
    "cache",
    "register",
    "average",
    "reconstruct",
    "correspondences",
    "pose_covariances",
    "joint_scan_covariances",
    "scan_covariances",
    "certify",
    "edge_report",
    "sandhu2010",
}


def pair(d: int, dtype: type, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Two noisy samples of a closed surface, some degrees apart."""
    source, target = problems.pair(d, seed)
    return jnp.asarray(source, dtype), jnp.asarray(target, dtype)


def scans(d: int, dtype: type, seed: int = 0) -> jax.Array:
    """Three samples of a closed surface, some degrees apart."""
    moves = [problems.motion(d, 0.3, 0.1, 10 * seed + i) for i in range(3)]
    samples = [problems.surface(NUM_POINTS, d, i) for i in range(3)]
    moved = [problems.move(T, x) for T, x in zip(moves, samples, strict=True)]
    return jnp.asarray(np.stack(moved), dtype)


def measured(d: int, dtype: type, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Motions of a graph, and their weights."""
    T = problems.relative_motions(d, 0.035, seed)[:-1]
    weight = np.random.default_rng(seed).uniform(0.5, 1.5, len(T))
    return jnp.asarray(T, dtype), jnp.asarray(weight, dtype)


def graph(T_i_j: jax.Array, weight: jax.Array) -> jr.PoseGraph:
    """The graph of those motions."""
    return jr.PoseGraph.from_edges(EDGES[:-1], T_i_j, NUM_POSES, weight)
