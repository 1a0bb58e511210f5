"""Robust averaging of small graphs: Gauss-Newton steps under a kernel that shrinks.

Descents follow each other, and all are one program, as compiling it is what a first
call takes. The first takes no step: it judges the start. The second takes a few without
a kernel, and the likelier of both poses are annealed: from the likeliest width, from
half of it where that loses likelihood, and so on; from where that ends widths settle;
and where that loses likelihood they go on annealing instead.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg.averaging.likelihood import (
    DEVIATIONS,
    Explained,
    Likelihood,
    least_after_fitting,
)
from jaxreg.averaging.steps.gauss_newton import gauss_newton_step
from jaxreg.averaging.steps.gradients import gauss_newton_gradients
from jaxreg.averaging.steps.iterate import Iterated, going_on, iterate
from jaxreg.averaging.steps.kernel_width import (
    first_width,
    followed_width,
    gaussian_trust,
    width_rule,
)
from jaxreg.averaging.trace import AveragingTrace, no_rows
from jaxreg.graph.pose_graph import PoseGraph


# Radians, and shares of the scene: so near annealing ends; settled widths do the rest.
_NEARLY = 1e-3
# Steps without a kernel, and how near they end: enough to tell which way is likelier.
_PLAIN_STEPS, _PLAIN_NEARLY = 3, 1e-2
# So many scenes and radians wide every edge counts fully.
_NO_KERNEL = 1e6
# What comes before and after the descents from ever narrower kernels, 0, 1, ...
_JUDGING, _PLAIN = -2, -1
_SETTLING, _GOING_ON, _DONE = len(DEVIATIONS), len(DEVIATIONS) + 1, len(DEVIATIONS) + 2


def annealed(
    graph: PoseGraph,
    likelihood: Likelihood,
    T_start: Float[Array, "v D D"],
    max_steps: int,
    tolerance: Array | float,
) -> tuple[Iterated, Float[Array, ""]]:
    """The end of the descents, and its `log_evidence`.

    A kernel that is too wide draws poses to a larger group of edges that agree less
    well; one that is too narrow fits noise. So a descent loses if it loses more
    likelihood than chance would. A chain of good edges drifts, and a kernel would drop
    the loops that it then leaves open: steps without a kernel spread the drift. With
    wrong edges about they agree with few, and the start stands. Where nothing agrees at
    the end it stands, too: a wide kernel blurs its tree.

    Gradients: implicit at the fixed point; widths are followed where they settled.
    """
    T_start, tolerance = jax.lax.stop_gradient((T_start, tolerance))
    descents = _Descents(likelihood, max_steps, tolerance)
    # Not on the driver: what it would carry is a number and whole ends of it.
    found = control.while_loop(
        lambda before: before.stage < _DONE,
        lambda before: descents.after(before),
        descents.start(T_start),
    )
    followed = eqx.Partial(followed_width, likelihood.scale)
    end = gauss_newton_gradients(graph, found.end, gaussian_trust, followed)
    nothing = found.evidence <= 0
    end = end._replace(
        T_world_i=jnp.where(nothing, T_start, end.T_world_i),
        trust=jnp.where(nothing, found.start.right, end.trust),
    )
    return end, jnp.where(nothing, found.start.evidence, found.evidence)


class _Start(NamedTuple):
    """What is known of the start, and where kernels begin to narrow.

    Attributes:
        evidence: `log_evidence` of the start.
        right: how probable each edge is right if the start is.
        T_world_i: the start, or what plain steps make of it: kernels narrow from there.
        log_ratio: of those poses.
        width: the first one there.
    """

    evidence: Float[Array, ""]
    right: Float[Array, " e"]
    T_world_i: Float[Array, "v D D"]
    log_ratio: Float[Array, ""]
    width: Float[Array, "2"]


class _Descended(NamedTuple):
    """Where the descents so far led.

    Attributes:
        stage: what comes next: a width, halved so many times, or one of the above.
        least: log likelihood ratio below which the next descent loses.
        start: see there.
        end: of the descents that did not lose.
        evidence: its `log_evidence`.
    """

    stage: Int[Array, ""]
    least: Float[Array, ""]
    start: _Start
    end: Iterated
    evidence: Float[Array, ""]

    def judged(
        self, end: Iterated, told: Explained, alone: Explained, scale: Array
    ) -> "_Descended":
        """After the start is judged, or plain steps from it."""
        first, start = self.stage == _JUDGING, self.start
        better = first | (told.log_ratio > start.log_ratio)
        right, width = jax.nn.sigmoid(alone.log_odds), first_width(alone, scale)
        start = _Start(
            evidence=jnp.where(first, alone.log_ratio, start.evidence),
            right=jnp.where(first, right, start.right),
            T_world_i=jnp.where(better, end.T_world_i, start.T_world_i),
            log_ratio=jnp.where(better, told.log_ratio, start.log_ratio),
            width=jnp.where(better, width, start.width),
        )
        least = jnp.where(better, least_after_fitting(told), self.least)
        return self._replace(stage=self.stage + 1, least=least, start=start)

    def followed_by(
        self, end: Iterated, told: Explained, alone: Explained
    ) -> "_Descended":
        """After one more descent under a kernel."""
        stage, loses = self.stage, told.log_ratio < self.least
        opening = stage < _SETTLING
        again = opening & loses & (stage < _SETTLING - 1)
        blurs = loses & (stage == _SETTLING)
        later = jnp.where(opening, _SETTLING, jnp.where(blurs, _GOING_ON, _DONE))
        last = going_on(self.end, end)
        return self._replace(
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
            evidence=jnp.where(blurs, self.evidence, alone.log_ratio),
        )


class _Descents(eqx.Module):
    """One after another, under the likelihood of the motions."""

    likelihood: Likelihood
    max_steps: int = eqx.field(static=True)
    tolerance: Array | float

    def start(self, T_start: Float[Array, "v D D"]) -> _Descended:
        """Before the start is judged."""
        weight, dtype = self.likelihood.graph.weight, T_start.dtype
        low, none = -jnp.full((), jnp.inf, dtype), jnp.asarray(0, jnp.int32)
        width = jnp.ones(2, dtype)
        end = Iterated(
            T_world_i=T_start,
            trust=jnp.zeros_like(weight),
            width=width,
            converged=jnp.asarray(False),
            num_steps=none,
            trace=AveragingTrace.of(no_rows(self.max_steps, dtype), none),
        )
        start = _Start(low, jnp.zeros_like(weight), T_start, low, width)
        return _Descended(jnp.asarray(_JUDGING, jnp.int32), low, start, end, low)

    def after(self, before: _Descended) -> _Descended:
        """After one more descent."""
        likelihood, stage = self.likelihood, before.stage
        end = self._end(before)
        told, alone = likelihood.explained_both(end.T_world_i)
        return jax.tree.map(
            lambda early, later: jnp.where(stage < 0, early, later),
            before.judged(end, told, alone, likelihood.scale),
            before.followed_by(end, told, alone),
        )

    def _end(self, before: _Descended) -> Iterated:
        """Of the next descent."""
        stage, start, scale = before.stage, before.start, self.likelihood.scale
        plain, opening = stage == _PLAIN, stage < _SETTLING
        narrowed = start.width / 2 ** jnp.maximum(stage, 0)
        begin = jnp.where(opening, narrowed, before.end.width)
        begin = jnp.where(plain, _NO_KERNEL * jnp.stack([scale, 1.0]), begin)
        return iterate(
            self.likelihood.graph,
            jnp.where(opening, start.T_world_i, before.end.T_world_i),
            begin,
            width_rule(scale, begin, stage == _SETTLING, held=plain),
            gaussian_trust,
            gauss_newton_step,
            max_steps=self.max_steps,
            at_most=jnp.where(plain, _PLAIN_STEPS, self.max_steps),
            tolerance=self._tolerance(stage),
        )

    def _tolerance(self, stage: Int[Array, ""]) -> Float[Array, ""]:
        """How near each descent ends; the start as it is."""
        opening = jnp.where(stage == _PLAIN, _PLAIN_NEARLY, _NEARLY)
        opening = jnp.where(stage == _JUDGING, jnp.inf, opening)
        return jnp.where(stage < _SETTLING, opening, self.tolerance)
