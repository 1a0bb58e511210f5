"""Motion averaging under the maximum correntropy criterion.

The criterion is that of Zhu, Hu, Lu, Chen, Li, Li, Robust Motion Averaging under
Maximum Correntropy Criterion (the MCC paper); start, widths and steps go beyond it.
`MCC` is the published algorithm.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_parts
from jaxreg._core.programs import kept_program
from jaxreg._core.programs_in_a_row import kept_programs
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, starting_poses
from jaxreg.averaging.likelihood import Likelihood
from jaxreg.averaging.methods.annealed import annealed
from jaxreg.averaging.methods.graduated import graduated
from jaxreg.averaging.methods.motion_averaging import iterate_plain
from jaxreg.averaging.start.closures import without_doubtful_closures
from jaxreg.averaging.start.cycle_consensus import CycleConsensus
from jaxreg.averaging.steps.iterate import solution_of
from jaxreg.averaging.steps.rows import RootRows
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import along_frames
from jaxreg.linear.laplacian import DENSE_LIMIT


class Correntropy(AbstractAverager):
    """Robust motion averaging: edges count by a Gaussian of their residual (Eq. 12).

    The default needs no start, no noise level and no tuning: a consensus of cycles as
    the start, and a kernel whose widths for rotation and translation shrink to three
    standard deviations of the noise that the agreeing edges show. Up to `DENSE_LIMIT`
    frames kernels are `annealed` by steps of Gauss-Newton, in which each part counts at
    its precision, or by `information` where the graph has it.
    Larger graphs take `graduated` steps; where those leave many edges out, the chain of
    successive frames is tried as a start, and that no motion is wrong.

    Attributes:
        max_steps: largest number of steps (static).
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many scene sizes; graphs of more than `DENSE_LIMIT` frames stop by
            their objective.
        initialiser: finds the start when `init` is None.

    Lengths are measured in the graph's own length scale, so another unit does not
    change the answer.

    Gradients: implicit at the fixed point with respect to `T_i_j`, `weight` and
    `information`; length scale and start are cut. Widths are followed where they have
    settled; those that did not settle near where annealing ended, and those of graphs
    above `DENSE_LIMIT` frames, are held: the derivative is that at held widths.
    """

    max_steps: int = eqx.field(static=True, default=100)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = CycleConsensus()

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(self, initialiser=AbstractAverager)
        check_counts(self, max_steps=1)
        check_not_negative(self, "tolerance")

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        if graph.num_poses > DENSE_LIMIT:
            return _average_large(self, graph, init, key)
        T_start = starting_poses(self.initialiser, graph, init, key)
        return self._small(graph, T_start)

    @kept_program
    def _small(
        self, graph: PoseGraph, T_start: Float[Array, "v D D"]
    ) -> AveragingSolution:
        likelihood = Likelihood.of(graph)
        end, evidence = annealed(
            graph, likelihood, T_start, self.max_steps, self.tolerance
        )
        return solution_of(graph, end, likelihood, evidence)


class _Started(eqx.Module):
    """A large graph, and the poses that it descends from.

    Attributes:
        near: the graph with the weights of plain steps.
        starts: poses; the likeliest of where they lead is kept.
    """

    method: Correntropy
    graph: PoseGraph
    likelihood: Likelihood
    near: PoseGraph
    starts: Float[Array, "m v D D"]


def _start(
    method: Correntropy,
    graph: PoseGraph,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> _Started:
    near = without_doubtful_closures(jax.lax.stop_gradient(graph))
    likelihood = Likelihood.of(graph)
    if init is None:
        T_start = starting_poses(method.initialiser, near, None, key)
        better = _better_start(likelihood, T_start, near)
        starts = [better, along_frames(graph)]
    else:
        # A start of the caller's may be far off: plain steps that leave out what
        # pulls against them would bend it for good.
        starts = [_better_start(likelihood, init, graph)]
    return _Started(method, graph, likelihood, near, jnp.stack(starts))


def _descend(given: _Started) -> AveragingSolution:
    graph, likelihood = given.graph, given.likelihood
    how = given.near, given.starts, given.method.max_steps
    return solution_of(graph, graduated(graph, likelihood, *how), likelihood)


_average_large = kept_programs(_start, _descend)


def _better_start(
    likelihood: Likelihood, T_start: Float[Array, "v D D"], near: PoseGraph
) -> Float[Array, "v D D"]:
    """The start, or what a few plain steps make of it if that is likelier.

    A chain of good edges drifts: its loop closures then look wrong, and a redescending
    kernel would drop them. Plain averaging spreads the drift; with wrong edges about,
    it agrees with few, and the start stands. The steps have the weights of `near`.
    """
    plain = iterate_plain(near, T_start, RootRows(), max_steps=5, tolerance=1e-2)
    both = jnp.stack([T_start, plain.T_world_i])
    found = jax.lax.map(lambda T: likelihood.explained(T).log_ratio, both)
    return both[jnp.where(found[1] > found[0], 1, 0)]
