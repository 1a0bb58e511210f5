"""Motion averaging under the maximum correntropy criterion.

The criterion is that of Zhu, Hu, Lu, Chen, Li, Li, Robust Motion Averaging under
Maximum Correntropy Criterion (the MCC paper); start, widths and steps go beyond it.
`MCC` is the published algorithm.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_parts
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, starting_poses
from jaxreg.averaging.likelihood import (
    DEVIATIONS,
    Explained,
    explained,
    least_after_fitting,
    log_evidence,
)
from jaxreg.averaging.methods.graduated import graduated
from jaxreg.averaging.methods.motion_averaging import iterate_plain
from jaxreg.averaging.start.closures import without_lone_closures
from jaxreg.averaging.start.cycle_consensus import CycleConsensus
from jaxreg.averaging.steps.gauss_newton import gauss_newton_step
from jaxreg.averaging.steps.gradients import gauss_newton_gradients
from jaxreg.averaging.steps.iterate import (
    Iterated,
    WidthOf,
    going_on,
    iterate,
    solution_of,
)
from jaxreg.averaging.steps.kernel_width import (
    annealed_width,
    first_width,
    followed_width,
    gaussian_trust,
    settled_width,
)
from jaxreg.averaging.steps.rows import RootRows
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import along_frames
from jaxreg.linear.laplacian import DENSE_LIMIT


# Radians, and shares of the scene: so near annealing ends; settled widths do the rest.
_NEARLY = 1e-3


class Correntropy(AbstractAverager):
    """Robust motion averaging: edges count by a Gaussian of their residual (Eq. 12).

    The default needs no start, no noise level and no tuning: a consensus of cycles as
    the start, and a kernel whose widths for rotation and translation shrink to three
    standard deviations of the noise that the agreeing edges show. Up to `DENSE_LIMIT`
    frames the steps are those of Gauss-Newton, in which each part counts at its
    precision, or by `information` where the graph has it.
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
            return self._large(graph, init, key)
        T_start = starting_poses(self.initialiser, graph, init, key)
        return self._small(graph, T_start)

    @kept_program
    def _small(
        self, graph: PoseGraph, T_start: Float[Array, "v D D"]
    ) -> AveragingSolution:
        """From the likeliest width; from half of it where that loses likelihood.

        A kernel that is too wide draws poses to a larger group of edges that agree
        less well; one that is too narrow fits noise. So it loses if it loses more than
        chance would.
        """
        fixed, T_start = jax.lax.stop_gradient((graph, T_start))
        scale = fixed.length_scale
        T, found = _better_start(fixed, T_start, fixed)
        least = least_after_fitting(found)
        width = first_width(fixed, T)

        def annealing(g: PoseGraph, T: Array, width: Array) -> Array:
            return annealed_width(g, T, width, scale)

        def from_width(width: Array) -> Iterated:
            return self._steps(fixed, T, width, annealing, _NEARLY)

        def narrower(tried: tuple[Array, Explained, Iterated]) -> tuple:
            number = tried[0]
            end = from_width(width / 2**number)
            return number + 1, explained(fixed, end.T_world_i), end

        blank = jax.eval_shape(lambda: from_width(width))
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank)
        nothing = found._replace(log_ratio=jnp.full_like(least, -jnp.inf))
        # Not on the driver: what it would carry is a number and whole ends of it.
        _, found, end = control.while_loop(
            lambda tried: (tried[1].log_ratio < least) & (tried[0] < len(DEVIATIONS)),
            narrower,
            (jnp.asarray(0, jnp.int32), nothing, blank),
        )
        end = self._finished(fixed, end, annealing, least_after_fitting(found))
        followed = eqx.Partial(followed_width, scale)
        end = gauss_newton_gradients(graph, end, gaussian_trust, followed)
        return solution_of(graph, _or_start(graph, end, T_start))

    def _finished(
        self, graph: PoseGraph, end: Iterated, annealing: WidthOf, least: Array
    ) -> Iterated:
        """The last digits, at widths that settle.

        Unless that blurs: likelihood falls below the least. Then as before.
        """
        start = graph, end.T_world_i, end.width
        settled = self._steps(
            *start, settled_width(graph.length_scale, end.width), self.tolerance
        )
        blurs = explained(graph, settled.T_world_i).log_ratio < least
        enough = jnp.where(blurs, self.tolerance, jnp.inf)  # no step if it does not
        annealed = self._steps(*start, annealing, enough)
        last = jax.tree.map(lambda a, b: jnp.where(blurs, a, b), annealed, settled)
        return going_on(end, last)

    def _steps(
        self,
        graph: PoseGraph,
        T_start: Array,
        width: Array,
        width_of: WidthOf,
        tolerance: Array | float,
    ) -> Iterated:
        return iterate(
            graph,
            T_start,
            width,
            width_of,
            gaussian_trust,
            gauss_newton_step,
            max_steps=self.max_steps,
            tolerance=tolerance,
        )

    @kept_program
    def _large(
        self, graph: PoseGraph, init: Float[Array, "v D D"] | None, key: Key | None
    ) -> AveragingSolution:
        near = without_lone_closures(jax.lax.stop_gradient(graph))
        if init is None:
            T_start = starting_poses(self.initialiser, near, None, key)
            better, _ = _better_start(graph, T_start, near)
            starts = [better, along_frames(graph)]
        else:
            # A start of the caller's may be far off: plain steps that leave out what
            # pulls against them would bend it for good.
            starts = [_better_start(graph, init, graph)[0]]
        end = graduated(graph, near, jnp.stack(starts), self.max_steps)
        return solution_of(graph, end)


def _or_start(graph: PoseGraph, end: Iterated, T_start: Array) -> Iterated:
    """The start where nothing agrees at the end: a wide kernel then blurs its tree.

    Trust is then the probability that an edge is right if the start is.
    """
    graph, T_start = jax.lax.stop_gradient((graph, T_start))
    nothing = log_evidence(graph, end.T_world_i) <= 0
    right = jax.nn.sigmoid(explained(graph, T_start, alone=True).log_odds)
    return end._replace(
        T_world_i=jnp.where(nothing, T_start, end.T_world_i),
        trust=jnp.where(nothing, right, end.trust),
    )


def _better_start(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    near: PoseGraph,
) -> tuple[Float[Array, "v D D"], Explained]:
    """The start, or what a few plain steps make of it if that is likelier; how likely.

    A chain of good edges drifts: its loop closures then look wrong, and a redescending
    kernel would drop them. Plain averaging spreads the drift; with wrong edges about,
    it agrees with few, and the start stands. The steps have the weights of `near`.
    """
    plain = iterate_plain(near, T_start, RootRows(), max_steps=5, tolerance=1e-2)
    both = jnp.stack([T_start, plain.T_world_i])
    found = jax.lax.map(lambda T: explained(graph, T), both)
    best = jnp.where(found.log_ratio[1] > found.log_ratio[0], 1, 0)
    return both[best], jax.tree.map(lambda x: x[best], found)
