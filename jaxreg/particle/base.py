"""The contract of global searches: draw poses, descend, conclude."""

import abc
import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

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
from jaxreg.particle.candidates import APART, Candidates, Found, LogPrior
from jaxreg.particle.conclude import conclude
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.pair import Pair
from jaxreg.particle.priors import (
    AbstractPrior,
    GaussianPrior,
    PartialPose,
    UniformPrior,
)
from jaxreg.particle.proposals import propose_modes
from jaxreg.registrar import (
    AbstractIndexedRegistrar,
    Frames,
    GivenPair,
    RegistrationSolution,
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

    @final
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

    @final
    def solve_indexed(
        self,
        source: PointCloud,
        target: PointCloud,
        target_index: AbstractIndex,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """`solve` with an index built before, for clouds that enter many pairs."""
        pair = Pair.of(source, target, target_index)
        return self.concluded(pair, self.candidates(pair, init, key))

    @final
    def candidates(
        self, pair: Pair, init: Motion | None, key: Key | None
    ) -> Candidates:
        """The first half of `solve`: poses that may be the answer.

        Not differentiated: the search's loops know no reverse mode.
        """
        held = cast_floats(self, pair.source.points.dtype)
        self, pair, init = lax.stop_gradient((held, pair, init))
        key_points, key_search = jax.random.split(check_key(key))
        few = _some_points(key_points, pair.problem, self.num_points)
        found = self.search(key_search, few, init)
        proposals = self._proposals(pair, found.sure, init)
        return Candidates.of(found, self.num_modes, proposals, self._log_prior)

    @final
    def concluded(self, pair: Pair, candidates: Candidates) -> RegistrationSolution:
        """The second half: the candidates refined and judged.

        It has derivatives, by what its last steps depend on.
        """
        moving = cast_floats(self, pair.source.points.dtype)
        held = lax.stop_gradient(moving)
        return conclude(
            pair,
            candidates,
            held._log_prior,
            kernel=moving.kernel,
            num_modes=held.num_modes,
            refine_steps=held.refine_steps,
            min_log_evidence=held.min_log_evidence,
        )

    @property
    def _log_prior(self) -> LogPrior | None:
        return None if self.prior is None else self.prior.log_density

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
