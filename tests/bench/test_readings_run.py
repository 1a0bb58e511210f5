"""Every reading of the papers runs in the plane and in space."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from jaxtyping import Array

from bench.workloads.readings_averaging import Reading
from bench.workloads.readings_filter import UncorrelatedSpread
from jaxreg.averaging import MCC, WeightRows, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error
from jaxreg.particle import (
    AbstractDynamics,
    ConstantVelocity,
    EnsembleSpread,
    GaussianPrior,
    MeasuredSpread,
    NoDynamics,
    OwnSpread,
    PathSpread,
    StochasticDynamics,
    sandhu2010,
)
from jaxreg.robust import Huber
from tests.averaging.graphs import random_graph


P, N = 16, 96
SPREADS = (
    OwnSpread(),
    PathSpread(),
    EnsembleSpread(),
    MeasuredSpread(),
    UncorrelatedSpread(),
)
NUM_DYNAMICS = 2 + len(SPREADS)


class _AnyOf(AbstractDynamics):
    """The dynamics of all readings, one by a traced number: they compile together."""

    which: Array

    @property
    def needs_path(self) -> bool:
        return True

    def __call__(self, key, particles, time):
        every = [NoDynamics(), ConstantVelocity()]
        every += [StochasticDynamics(jnp.float32(1), spread) for spread in SPREADS]
        return jnp.stack([one(key, particles, time) for one in every])[self.which]


@eqx.filter_jit
def _answer(method, source, target, key):
    filtering = method.iteration(source, target, key=key)
    state, _ = filtering.scan(key, jnp.eye(source.shape[1] + 1))
    return filtering.problem.frames.leave(state.particles.measurement)


@pytest.mark.parametrize("d", [2, 3])
def test_readings_of_the_filter_find_an_easy_pose(d):
    target = blob(N, d)
    T = motion(4, d, angle=0.3, shift=0.1)
    source = move(np.linalg.inv(T), target)
    readings = [(which, 1e6, 0.1) for which in range(NUM_DYNAMICS)]
    readings += [(0, 0.1, 0.1), (0, 1e6, 1 / P), (0, 1e6, 0.98)]  # LM-ICP's; trust
    for which, width, share in readings:
        method = eqx.tree_at(
            lambda m: (m.width_start, m.width_end, m.sample_share),
            sandhu2010(
                d,
                P,
                _AnyOf(jnp.asarray(which)),
                prior=GaussianPrior(0.2, 0.2),
                num_times=10,
            ),
            (jnp.asarray(width), jnp.asarray(width), jnp.asarray(share)),
        )
        method = eqx.tree_at(lambda m: m.kernel, method, Huber())
        found = _answer(method, source, target, jax.random.key(0))
        angle, shift = pose_error(found, T)
        assert angle < 0.05, (which, width, share)
        assert shift < 0.05, (which, width, share)


@pytest.mark.parametrize("d", [2, 3])
def test_readings_of_averaging_recover_exact_motions(d):
    X, edges, T, _ = random_graph(8, 24, 0.0, 0, d=d, noise=0.0)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), len(X))
    readings = [Reading(mean=float(kind)) for kind in range(len(Reading.MEANS))]
    readings += [Reading(unit=1.0), MCC(alpha=0.5), MCC(rows=WeightRows())]
    true = jnp.asarray(X, jnp.float32)
    for reading in readings:
        found = average(graph, reading)
        assert rotation_error(found.T_world_i, true) < 1e-3
    if d == 3:  # as Eq. 21 prints it, the update leads away; in the plane it may
        found = average(graph, Reading(on_the_right=True))
        assert rotation_error(found.T_world_i, true) > 0.1
