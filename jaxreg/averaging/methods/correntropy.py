"""Motion averaging under the maximum correntropy criterion.

The criterion is that of Zhu, Hu, Lu, Chen, Li, Li, Robust Motion Averaging under
Maximum Correntropy Criterion (the MCC paper); start, widths and steps go beyond it.
`MCC` is the published algorithm.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_parts
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    length_scale,
    start,
)
from jaxreg.averaging.evidence import coherence, redundancy
from jaxreg.averaging.methods.graduated import graduated
from jaxreg.averaging.methods.motion_averaging import iterate_plain
from jaxreg.averaging.start.closures import without_lone_closures
from jaxreg.averaging.start.cycle_consensus import CycleConsensus
from jaxreg.averaging.steps.gauss_newton import (
    gauss_newton_gradients,
    gauss_newton_step,
)
from jaxreg.averaging.steps.iterate import Iterated, iterate, solution_of
from jaxreg.averaging.steps.kernel_width import (
    annealed_width,
    first_width,
    followed_width,
    gaussian_trust,
)
from jaxreg.averaging.steps.rows import RootRows
from jaxreg.averaging.trace import AveragingTrace, no_rows
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import along_frames
from jaxreg.linear.laplacian import DENSE_LIMIT


# Kernels of at most this width, radians and length scales, hold on to a start.
_NARROW = 0.25
# Share of the other end's agreement beyond a tree that an end must reach.
_ENOUGH = 0.7


class Correntropy(AbstractAverager):
    """Robust motion averaging: edges count by a Gaussian of their residual (Eq. 12).

    The default needs no start, no noise level and no tuning: a consensus of cycles as
    the start, and a kernel whose widths for rotation and translation shrink to three
    standard deviations of the noise that the agreeing edges show. Up to `DENSE_LIMIT`
    frames the steps are those of Gauss-Newton, in which each part counts at its
    precision, or by `information` where the graph has it; a wide kernel may draw a
    start to a larger, less coherent group, so a narrow one is tried, too.
    Larger graphs take `graduated` steps; where those leave many edges out, the chain of
    successive frames is tried as a start, and that no motion is wrong.

    Attributes:
        max_steps: largest number of steps (static).
        tolerance: stop below this change, radians and share of the size of the scene.
        initialiser: finds the start when `init` is None.

    Lengths are measured in the graph's own length scale, so another unit does not
    change the answer.

    Gradients: implicit at the fixed point with respect to `T_i_j`, `weight` and
    `information`; length scale and start are cut. Widths are followed if they have
    settled; widths that would grow, but may not, and those of graphs above
    `DENSE_LIMIT` frames, are held, and then the derivative is that at held widths.
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
            return self._large(graph, init, key)
        T_start = start(self.initialiser, graph, init, key)
        return self._small(graph, T_start, init is None)

    @eqx.filter_jit
    def _large(
        self, graph: PoseGraph, init: Float[Array, "v D D"] | None, key: Key | None
    ) -> AveragingSolution:
        return solution_of(graph, self._graduated(graph, init, key))

    @eqx.filter_jit
    def _small(
        self, graph: PoseGraph, T_start: Float[Array, "v D D"], compare: bool
    ) -> AveragingSolution:
        return solution_of(graph, self._annealed(graph, T_start, compare))

    def _annealed(
        self, graph: PoseGraph, T_start: Float[Array, "v D D"], compare: bool
    ) -> Iterated:
        """Ends from a wide kernel or, where more coherent, from a narrow one."""
        fixed, T_start = jax.lax.stop_gradient((graph, T_start))
        scale = length_scale(fixed)
        followed = eqx.Partial(followed_width, scale)
        T_wide = _better_start(fixed, T_start, fixed)
        width = first_width(fixed, T_wide)
        if not compare:
            end = self._from_width(fixed, T_wide, width)
            return gauss_newton_gradients(graph, end, gaussian_trust, followed)
        narrow = jnp.minimum(width, _NARROW * jnp.stack([scale, jnp.ones_like(scale)]))
        doubt = (width[1] > _NARROW) | jnp.any(T_wide != T_start)

        def tried(number: Array, best: _Tried) -> _Tried:
            first = number == 0
            T = jnp.where(first, T_wide, T_start)
            end = self._from_width(fixed, T, jnp.where(first, width, narrow))
            score = coherence(fixed, end.T_world_i, scale)
            # A kernel narrower than the noise fits a tree, and little beyond.
            spare = redundancy(fixed, end.T_world_i)
            better = first | (
                (score > best.score) & (spare > _ENOUGH * best.redundancy)
            )
            new = _Tried(end, score, spare)
            return jax.tree.map(lambda new, old: jnp.where(better, new, old), new, best)

        zero = jnp.asarray(0, jnp.int32)
        nowhere = Iterated(
            T_start,
            jnp.zeros_like(graph.weight),
            width,
            jnp.asarray(False),
            zero,
            AveragingTrace.of(no_rows(self.max_steps, width.dtype), zero),
        )
        none = _Tried(nowhere, jnp.zeros_like(scale), jnp.zeros_like(scale))
        end = jax.lax.fori_loop(0, jnp.where(doubt, 2, 1), tried, none).end
        return gauss_newton_gradients(graph, end, gaussian_trust, followed)

    def _from_width(self, graph: PoseGraph, T_start: Array, width: Array) -> Iterated:
        scale = length_scale(graph)
        return iterate(
            graph,
            T_start,
            width,
            lambda g, T, w: annealed_width(g, T, w, scale),
            gaussian_trust,
            gauss_newton_step,
            max_steps=self.max_steps,
            tolerance=self.tolerance,
        )

    def _graduated(
        self, graph: PoseGraph, init: Float[Array, "v D D"] | None, key: Key | None
    ) -> Iterated:
        near = without_lone_closures(jax.lax.stop_gradient(graph))
        if init is None:
            T_start = start(self.initialiser, near, None, key)
            starts = [_better_start(graph, T_start, near), along_frames(graph)]
        else:
            # A start of the caller's may be far off: plain steps that leave out what
            # pulls against them would bend it for good.
            starts = [_better_start(graph, init, graph)]
        return graduated(graph, near, jnp.stack(starts), self.max_steps)


class _Tried(NamedTuple):
    """Where a start led, and how well that agrees."""

    end: Iterated
    score: Array
    redundancy: Array


def _better_start(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    near: PoseGraph,
) -> Float[Array, "v D D"]:
    """The start, or what a few plain steps make of it if more edges agree with that.

    A chain of good edges drifts: its loop closures then look wrong, and a redescending
    kernel would drop them. Plain averaging spreads the drift; with wrong edges about,
    it agrees with few, and the start stands. The steps have the weights of `near`.
    """
    plain = iterate_plain(near, T_start, RootRows(), max_steps=5, tolerance=1e-2)
    both = jnp.stack([T_start, plain.T_world_i])
    spare = jax.vmap(lambda T: redundancy(graph, T))(both)
    return jnp.where(spare[1] > spare[0], both[1], both[0])
