"""Motion averaging under the maximum correntropy criterion, as published.

Reference: Zhu, Hu, Lu, Chen, Li, Li, Robust Motion Averaging under Maximum Correntropy
Criterion (the MCC paper): Algorithm 1, with the update of Eq. 21 on the left, where
Eq. 14 needs it, and "until change is negligible and k >= K" read as "or".
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import (
    check_counts,
    check_not_negative,
    check_parts,
    check_positive,
)
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, starting_poses
from jaxreg.averaging.measures import frobenius, weighted_mean
from jaxreg.averaging.start.cycle_consensus import CycleConsensus
from jaxreg.averaging.steps.gradients import averaging_gradients
from jaxreg.averaging.steps.iterate import averaging_step, iterate, solution_of
from jaxreg.averaging.steps.kernel_width import gaussian_trust
from jaxreg.averaging.steps.rows import AbstractRows, RootRows
from jaxreg.graph.pose_graph import PoseGraph


class MCC(AbstractAverager):
    """The paper's Algorithm 1: edges count by a Gaussian of their residual (Eq. 12).

    The width of the kernel is sigma_k = alpha e_k with the mean residual e_k of Eq. 22.
    It does not shrink to the noise of the right edges while wrong ones are about:
    `Correntropy` goes beyond that.

    Attributes:
        alpha: kernel width over the mean residual.
        rows: `RootRows()`, as half-quadratic theory asks, or `WeightRows()`, as printed
            in Eq. 17.
        max_steps: largest number of steps (static).
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many scene sizes (length scale of the graph plus spread of poses).
        initialiser: finds the start when `init` is None.

    Lengths are measured in the graph's own length scale, so another unit does not
    change the answer.

    Gradients: implicit at the fixed point with respect to `T_i_j`, `weight` and
    `alpha`; length scale and start are cut.
    """

    alpha: Array | float = traced(1.0)
    rows: AbstractRows = RootRows()
    max_steps: int = eqx.field(static=True, default=100)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = CycleConsensus()

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(self, rows=AbstractRows, initialiser=AbstractAverager)
        check_counts(self, max_steps=1)
        check_positive(self, "alpha")
        check_not_negative(self, "tolerance")

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        return self._from_start(
            graph, starting_poses(self.initialiser, graph, init, key)
        )

    @kept_program
    def _from_start(
        self, graph: PoseGraph, T_start: Float[Array, "v D D"]
    ) -> AveragingSolution:
        scale = graph.length_scale
        end = iterate(
            graph,
            T_start,
            jnp.full((2,), jnp.inf, scale.dtype),
            eqx.Partial(_width, jax.lax.stop_gradient(self.alpha), scale),
            gaussian_trust,
            averaging_step(self.rows),
            max_steps=self.max_steps,
            tolerance=self.tolerance,
        )
        end = averaging_gradients(
            graph,
            end,
            gaussian_trust,
            self.rows,
            eqx.Partial(_width, self.alpha, scale),
        )
        return solution_of(graph, end)


def _width(
    alpha: Array | float, scale: Array, g: PoseGraph, T: Array, _: Array
) -> Float[Array, "2"]:
    """Sigma = alpha times the mean residual (Eq. 22)."""
    e = weighted_mean(frobenius(g, T, scale), g.weight)
    sigma = alpha * jnp.maximum(e, 64 * jnp.finfo(e.dtype).eps)
    # The Frobenius norm of a small rotation is sqrt(2) times its angle.
    return jnp.stack([sigma * scale, sigma / jnp.sqrt(jnp.asarray(2, e.dtype))])
