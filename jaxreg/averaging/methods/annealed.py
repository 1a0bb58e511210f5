"""Robust averaging of small graphs: Gauss-Newton steps under a kernel that shrinks.

Descents follow each other, and all are one program, as compiling it is what a first
call takes. The first anneals from the likeliest width, from half of it where that
loses likelihood, and so on; from where it ends widths settle; and where that loses
likelihood they go on annealing instead.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.likelihood import (
    DEVIATIONS,
    Explained,
    Likelihood,
    least_after_fitting,
)
from jaxreg.averaging.methods.motion_averaging import iterate_plain
from jaxreg.averaging.steps.gauss_newton import gauss_newton_step
from jaxreg.averaging.steps.gradients import gauss_newton_gradients
from jaxreg.averaging.steps.iterate import Iterated, going_on, iterate, solution_of
from jaxreg.averaging.steps.kernel_width import (
    first_width,
    followed_width,
    gaussian_trust,
    width_rule,
)
from jaxreg.averaging.steps.rows import RootRows
from jaxreg.averaging.trace import AveragingTrace, no_rows
from jaxreg.graph.pose_graph import PoseGraph


# Radians, and shares of the scene: so near annealing ends; settled widths do the rest.
_NEARLY = 1e-3
# What follows the descents from ever narrower kernels.
_SETTLING, _GOING_ON, _DONE = len(DEVIATIONS), len(DEVIATIONS) + 1, len(DEVIATIONS) + 2


def annealed(
    graph: PoseGraph,
    likelihood: Likelihood,
    T_start: Float[Array, "v D D"],
    max_steps: int,
    tolerance: Array | float,
) -> Iterated:
    """The end of the descents from a start, or from what plain steps make of it.

    A kernel that is too wide draws poses to a larger group of edges that agree less
    well; one that is too narrow fits noise. So a descent loses if it loses more
    likelihood than chance would.

    Gradients: implicit at the fixed point; widths are followed where they settled.
    """
    fixed, T_start = likelihood.graph, jax.lax.stop_gradient(T_start)
    T, found = better_start(likelihood, T_start, fixed)
    width = first_width(likelihood, T)

    def descend(before: _Descended) -> _Descended:
        opening, settling = before.stage < _SETTLING, before.stage == _SETTLING
        begin = jnp.where(opening, width / 2**before.stage, before.end.width)
        end = iterate(
            fixed,
            jnp.where(opening, T, before.end.T_world_i),
            begin,
            width_rule(likelihood.scale, begin, settling),
            gaussian_trust,
            gauss_newton_step,
            max_steps=max_steps,
            tolerance=jnp.where(opening, _NEARLY, tolerance),
        )
        return before.followed_by(end, likelihood.explained(end.T_world_i))

    start = _Descended(
        stage=jnp.asarray(0, jnp.int32),
        least=least_after_fitting(found),
        end=_nothing_yet(fixed, T, width, max_steps),
    )
    # Not on the driver: what it would carry is a number and whole ends of it.
    end = control.while_loop(lambda x: x.stage < _DONE, descend, start).end
    followed = eqx.Partial(followed_width, likelihood.scale)
    return gauss_newton_gradients(graph, end, gaussian_trust, followed)


class _Descended(NamedTuple):
    """Where the descents so far led.

    Attributes:
        stage: what comes next: a width, halved so many times, or one of the above.
        least: log likelihood ratio below which the next descent loses.
        end: of those that did not lose.
    """

    stage: Int[Array, ""]
    least: Float[Array, ""]
    end: Iterated

    def followed_by(self, end: Iterated, told: Explained) -> "_Descended":
        """After one more descent, and how well its end explains the motions."""
        stage, loses = self.stage, told.log_ratio < self.least
        opening = stage < _SETTLING
        again = opening & loses & (stage < _SETTLING - 1)
        blurs = loses & (stage == _SETTLING)
        later = jnp.where(opening, _SETTLING, jnp.where(blurs, _GOING_ON, _DONE))
        last = going_on(self.end, end)
        return _Descended(
            stage=jnp.where(again, stage + 1, later),
            least=jnp.where(opening & ~again, least_after_fitting(told), self.least),
            end=jax.tree.map(
                lambda old, first, next_one: jnp.where(
                    opening, first, jnp.where(blurs, old, next_one)
                ),
                self.end,
                end,
                last,
            ),
        )


def _nothing_yet(graph: PoseGraph, T: Array, width: Array, max_steps: int) -> Iterated:
    none = jnp.asarray(0, jnp.int32)
    return Iterated(
        T_world_i=T,
        trust=jnp.zeros_like(graph.weight),
        width=width,
        converged=jnp.asarray(False),
        num_steps=none,
        trace=AveragingTrace.of(no_rows(max_steps, T.dtype), none),
    )


def better_start(
    likelihood: Likelihood,
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
    found = jax.lax.map(likelihood.explained, both)
    best = jnp.where(found.log_ratio[1] > found.log_ratio[0], 1, 0)
    return both[best], jax.tree.map(lambda x: x[best], found)


def or_start(
    graph: PoseGraph, likelihood: Likelihood, end: Iterated, T_start: Array
) -> AveragingSolution:
    """The solution; the start where nothing agrees at the end.

    A wide kernel then blurs the start's tree. Trust is the probability that an edge is
    right if the start is.
    """
    both = jax.lax.stop_gradient(jnp.stack([end.T_world_i, T_start]))
    found = jax.lax.map(lambda T: likelihood.explained(T, alone=True), both)
    nothing = found.log_ratio[0] <= 0
    right = jax.nn.sigmoid(found.log_odds[1])
    end = end._replace(
        T_world_i=jnp.where(nothing, jax.lax.stop_gradient(T_start), end.T_world_i),
        trust=jnp.where(nothing, right, end.trust),
    )
    evidence = jnp.where(nothing, found.log_ratio[1], found.log_ratio[0])
    return solution_of(graph, end, likelihood, evidence)
