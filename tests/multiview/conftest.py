"""One sculpture, of which several modules ask different things."""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from helpers import switched_on

import jaxreg as jr
from jaxreg.datasets import sculpture_scans
from jaxreg.multiview import RelativeMotions


#: A lighter search than by default.
FILTER = jr.ParticleFilter(num_prior=1024, num_particles=64)


class Sculpture(NamedTuple):
    """Eight scans, their poses, and what `reconstruct` found and told meanwhile."""

    scans: list[np.ndarray]
    truth: np.ndarray
    solution: jr.ReconstructionSolution
    calls: list[tuple[str, int, int]]
    pairs: list[RelativeMotions]


@pytest.fixture(scope="session")
def reconstructed() -> Sculpture:
    """Without a guess, once for all modules of a process."""
    scans, truth = sculpture_scans(8, seed=0, points_per_scan=3000)
    scans = [s.astype(np.float32) for s in scans]
    calls, pairs = [], []
    with switched_on("jax_disable_most_optimizations", to=False):
        solution = jr.reconstruct(
            scans,
            key=jax.random.key(0),
            method=FILTER,
            progress=lambda *call: calls.append(call),
            on_pairs=pairs.append,
        )
    return Sculpture(scans, truth, solution, calls, pairs)
