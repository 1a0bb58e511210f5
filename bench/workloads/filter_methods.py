"""The methods that are run on the PF paper's letter, cube, truck and horse.

Every filter draws its particles from the same Gaussian around the pose in which the
source is given. The paper says only "the same spread"; here a deviation covers about
half of the largest displacement of an experiment, as its own comment says. Unless a
method is named otherwise, what is compared starts from the same prior.
"""

from dataclasses import replace
from typing import NamedTuple

from bench.workloads.filter_data import Trials
from jaxreg import KernelCorrelation
from jaxreg.particle import (
    ConstantVelocity,
    EnsembleSpread,
    GaussianPrior,
    MultiStart,
    NoDynamics,
    ParticleFilter,
    StochasticDynamics,
    sandhu2010,
)
from jaxreg.registrar import AbstractRegistrar


class Tried(NamedTuple):
    """A way to register the trials.

    `from_identity` hands over the identity as the guess, around which the paper's
    particles are drawn; else there is none and the clouds are centred.
    """

    name: str
    registrar: AbstractRegistrar
    from_identity: bool = True


PAPER = "paper's setting"
WHOLE = Tried("ParticleFilter(), no guess", ParticleFilter(), False)

# Displacements are up to 0.7 radii of the words and 1.05 rad.
LETTER_PRIOR = GaussianPrior(0.5, 0.6)
# Up to 1.4 radii of the cube and 1.05 rad.
CUBE_PRIOR = GaussianPrior(1.0, 0.6)
# 1.9 radii of the truck and 1.05 rad. With one radius, particles start near the truth
# and two of three searches succeed without dynamics.
TRUCK_PRIOR = GaussianPrior(0.8, 0.5)
# Translations are N(0, 45), 0.8 radii of the horse in each direction; turns up to 1.05.
HORSE_PRIOR = GaussianPrior(0.8, 0.6)


def _ours(prior: GaussianPrior) -> list[Tried]:
    return [
        Tried("ParticleFilter()", ParticleFilter(prior=prior)),
        Tried("MultiStart()", MultiStart(prior=prior)),
    ]


def _correlation(*bandwidths: float) -> list[Tried]:
    """The rival without thinning; bandwidths are in the unit of the points."""
    return [
        Tried(f"kernel correlation, {b:g}", KernelCorrelation(b, max_points=4096))
        for b in bandwidths
    ]


_IN_WORDS = [
    Tried(PAPER, sandhu2010(2, 200, prior=LETTER_PRIOR)),
    *_ours(LETTER_PRIOR),
    WHOLE,
    *_correlation(1.0, 2.0, 3.0, 5.0, 10.0, 20.0),
]
# The paper has R = 7 here and Gauss-Newton in space, for which it names R = 3.
_ON_CUBE = [
    Tried(
        PAPER,
        replace(sandhu2010(3, 100, prior=CUBE_PRIOR), prior_steps=7, inner_steps=7),
    ),
    Tried(f"{PAPER}, R = 3", sandhu2010(3, 100, prior=CUBE_PRIOR)),
    *_ours(CUBE_PRIOR),
    *_correlation(1.0, 2.0, 3.0, 5.0, 10.0, 20.0),
]
_ON_TRUCK = [
    Tried(PAPER, sandhu2010(3, 100, prior=TRUCK_PRIOR)),
    Tried(f"{PAPER}, no dynamics", sandhu2010(3, 100, NoDynamics(), prior=TRUCK_PRIOR)),
    Tried(
        f"{PAPER}, constant velocity",
        sandhu2010(3, 100, ConstantVelocity(), prior=TRUCK_PRIOR),
    ),
    Tried(
        f"{PAPER}, S of all particles",
        sandhu2010(
            3, 100, StochasticDynamics(spread=EnsembleSpread()), prior=TRUCK_PRIOR
        ),
    ),
    *_ours(TRUCK_PRIOR),
    # As many look-ups, spent otherwise.
    Tried(
        "ParticleFilter(), 1024 drawn, 288 carried",
        ParticleFilter(num_prior=1024, num_particles=288, prior=TRUCK_PRIOR),
    ),
    Tried(
        "ParticleFilter(), 1024 drawn, 9 steps each",
        ParticleFilter(num_prior=1024, prior_steps=9, prior=TRUCK_PRIOR),
    ),
    *_correlation(0.1, 0.25, 0.5, 1.0, 2.0, 4.0),
]
#: By the names of the experiments.
METHODS = {"letter": _IN_WORDS, "cube": _ON_CUBE, "truck": _ON_TRUCK}
HORSE = [Tried(PAPER, sandhu2010(3, 40, prior=HORSE_PRIOR)), WHOLE]


def look_ups(registrar: AbstractRegistrar, trials: Trials) -> int:
    """Closest points (pairs, for kernel correlation) of a search on one trial at most.

    Without those of the refinement and of the scores.
    """
    n, m = trials.source.shape[1], len(trials.target)
    if isinstance(registrar, KernelCorrelation):
        return registrar.max_steps * n * m
    if isinstance(registrar, MultiStart):
        each = registrar.num_starts * (registrar.num_steps + 1)
    else:
        assert isinstance(registrar, ParticleFilter)
        each = registrar.most_look_ups
    return each * min(n, registrar.num_points)
