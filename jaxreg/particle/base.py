"""The contract of global searches: draw poses, descend, conclude."""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import (
    check_counts,
    check_key,
    check_not_negative,
    check_numbers,
    check_parts,
    check_positive,
)
from jaxreg._core.typing import Key, Mask, Motion, Points
from jaxreg.cloud import PointCloud, thin, without_noise
from jaxreg.local import AbstractStep, LocalOptimiser
from jaxreg.matching import AbstractResidual, Problem
from jaxreg.neighbours import (
    AbstractIndex,
    IndexBuilder,
    VoxelTable,
    check_index,
)
from jaxreg.particle.conclude import APART, conclude
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.pair import Pair
from jaxreg.particle.priors import (
    AbstractPrior,
    GaussianPrior,
    PartialPose,
    UniformPrior,
)
from jaxreg.particle.proposals import propose_modes
from jaxreg.particle.state import Particles
from jaxreg.registrar import (
    AbstractIndexedRegistrar,
    Frames,
    GivenPair,
    RegistrationSolution,
    SearchTrace,
    prepare_pair,
)
from jaxreg.robust import AbstractKernel


# The agreement of normals decides what is trusted: the careful estimate.
_NORMAL_NEIGHBOURS = 10
# As many times more points tell the last digits. (Median errors of eleven lidar pairs
# with 4,096 points, 16,384 and all: 36, 14 and 22 mm.)
_FINE = 4
# Poses are judged by so many points, whatever number finds them: the evidence was
# learned on clouds thinned to as many, and so does not depend on `max_points`.
_JUDGED = 4096


class Found(eqx.Module):
    """What a search ended with.

    Attributes:
        particles: measured poses, with energies and weights.
        num_steps: int32, steps of the local optimiser along the path of one of them.
        finished: whether they had come to rest.
        sure: whether there is no need to look for other poses.
        trace: of the steps of a filter.
    """

    particles: Particles
    num_steps: Int[Array, ""]
    finished: Bool[Array, ""]
    sure: Bool[Array, ""]
    trace: SearchTrace | None = None


class AbstractSearch(AbstractIndexedRegistrar):
    """A registration method that needs no initial guess: many poses, few points."""

    prior: eqx.AbstractVar[AbstractPrior | None]
    energy: eqx.AbstractVar[AbstractEnergy]
    residual: eqx.AbstractVar[AbstractResidual]
    kernel: eqx.AbstractVar[AbstractKernel]
    step: eqx.AbstractVar[AbstractStep]
    width_start: eqx.AbstractVar[Array | float]
    width_end: eqx.AbstractVar[Array | float]
    tolerance: eqx.AbstractVar[Array | float]
    num_points: eqx.AbstractVar[int]
    index: eqx.AbstractVar[IndexBuilder | None]
    refine_steps: eqx.AbstractVar[int]
    num_proposals: eqx.AbstractVar[int]
    max_points: eqx.AbstractVar[int]
    batch_size: eqx.AbstractVar[int]

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that no search can use."""
        check_parts(
            self,
            prior=AbstractPrior | None,
            residual=AbstractResidual,
            kernel=AbstractKernel,
            step=AbstractStep,
            energy=AbstractEnergy,
        )
        check_index(self)
        check_counts(self, num_points=1, num_modes=1, max_points=1, batch_size=1)
        check_counts(self, refine_steps=0, num_proposals=0)
        check_positive(self, "width_start", "width_end")
        check_not_negative(self, "tolerance")
        check_numbers(self, "min_log_evidence")

    @abc.abstractmethod
    def search(self, key: Key, problem: Problem, init: Motion | None) -> Found:
        """Searches on the points of the problem.

        Args:
            key: randomness.
            problem: as of `problem`.
            init: an initial guess between the frames of the input, where the problem
                knows them (`problem.frames`); else, and in the result, in its own.
        """

    def in_frames(self, frames: Frames) -> "AbstractSearch":
        """With the prior's poses in the frames of `solve`."""
        if self.prior is None:
            return self
        return eqx.tree_at(lambda m: m.prior, self, self.prior.in_frames(frames))

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Without noise that fills the box, thinned to `max_points`, with normals.

        And to `_FINE` times as many for the last steps, and to `_JUDGED` where those
        are not as many.
        """
        mask, n = without_noise(points, mask), len(mask)
        cloud, fine, judged = self._thinned(points, mask, self.max_points), None, None
        if n > self.max_points:
            fine = thin(points, mask, min(n, _FINE * self.max_points))
        if min(n, self.max_points) != min(n, _JUDGED):
            judged = self._thinned(points, mask, _JUDGED).with_spacing()
        return dataclasses.replace(cloud, fine=fine, judged=judged)

    def _thinned(self, points: Points, mask: Mask, num: int) -> PointCloud:
        return thin(points, mask, num, _NORMAL_NEIGHBOURS)

    def problem(self, pair: GivenPair, key: Key) -> Problem:
        """What `search` works on; traced."""
        ready = prepare_pair(self, pair)
        index = self.index_of(ready.target)
        problem = Problem.of(ready.source, ready.target, index, ready.frames)
        return _some_points(check_key(key), problem, self.num_points)

    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """Searches, refines and scores in the prepared frames."""
        key = check_key(key)
        return self.solve_indexed(source, target, self.index_of(target), init, key)

    def index_of(self, cloud: PointCloud) -> AbstractIndex:
        """Of the kind asked for; a voxel table if none is."""
        kind = VoxelTable if self.index is None else self.index
        return kind.build(cloud.points, cloud.mask)

    def solve_indexed(
        self,
        source: PointCloud,
        target: PointCloud,
        target_index: AbstractIndex,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """`solve` with an index built before, for clouds that enter many pairs."""
        # The search is not differentiated, its loops know no reverse mode; the answer
        # is, by what its last steps depend on.
        moving = cast_floats(self, source.points.dtype)
        moving_pair = Pair.of(source, target, target_index)
        self, pair, init = lax.stop_gradient((moving, moving_pair, init))
        key_points, key_search = jax.random.split(check_key(key))
        few = _some_points(key_points, pair.problem, self.num_points)
        found = self.search(key_search, few, init)
        solution = conclude(
            moving_pair,
            found.particles,
            found.num_steps,
            found.finished,
            self._proposals(pair, found.sure, init),
            None if self.prior is None else self.prior.log_density,
            kernel=moving.kernel,
            num_modes=self.num_modes,
            refine_steps=self.refine_steps,
            min_log_evidence=self.min_log_evidence,
        )
        return dataclasses.replace(solution, trace=found.trace)

    def proposes(self, d: int) -> bool:
        """Whether local features are looked at where no guess is given."""
        anywhere = self.prior is None or isinstance(self.prior, PartialPose)
        return self.num_proposals > 0 and anywhere and self.refine_steps > 0 and d == 3

    def _proposals(
        self, pair: Pair, sure: Bool[Array, ""], init: Motion | None
    ) -> tuple[Float[Array, "r 4 4"], Bool[Array, " r"]] | None:
        """Poses of local features and which are in use, where any may be the answer."""
        if init is not None or not self.proposes(pair.source.points.shape[1]):
            return None
        pair = pair.judged
        return propose_modes(
            pair.source,
            pair.target,
            pair.spacing,
            self.num_proposals,
            apart=jnp.asarray(APART, pair.source.points.dtype),
            wanted=~sure,
        )

    def optimiser(self, dtype: Any) -> LocalOptimiser:
        """Residual x kernel x step, in a dtype."""
        optimiser = LocalOptimiser(self.residual, self.kernel, self.step)
        return cast_floats(optimiser, dtype)

    def starts(
        self, key: Key, num: int, problem: Problem, init: Motion | None
    ) -> Float[Array, "p D D"]:
        """`num` poses of the prior and as many more as fill the last block."""
        d, dtype = problem.source.shape[0], problem.source.dtype
        prior, frames = self.prior, problem.frames
        if prior is None:
            prior = UniformPrior() if init is None else GaussianPrior()
        if frames is not None:
            prior = prior.in_frames(frames)
            init = None if init is None else frames.enter(init)
        T = cast_floats(prior, dtype).draw(key, num, d, init, dtype)
        batch = min(self.batch_size, num)
        surplus = -num % batch
        return jnp.concatenate([T, T[:surplus]]) if surplus else T


def _some_points(key: Key, problem: Problem, num: int) -> Problem:
    """The problem on a random subset of the valid source points."""
    if problem.source.shape[1] <= num:
        return problem
    order = jax.random.uniform(key, problem.source_mask.shape, problem.source.dtype)
    rows = jnp.argsort(jnp.where(problem.source_mask, order, 2))[:num]
    return problem.of_rows(rows)
