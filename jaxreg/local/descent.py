"""The loop of a local registration: match, weigh, step, until nothing moves.

From coarse to fine: while steps are large, a subset of the source is matched, by the
quickest look-up that the index has (a table); then all points by the index itself.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.loop import AbstractIteration
from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.scale import fit_scale
from jaxreg.local.steps import decoupled_error
from jaxreg.matching.problem import Match, Problem, match


# A descent begins with every so-many-th point, while it still takes large steps.
_MAX_STRIDE = 8
_MIN_COARSE_POINTS = 500
_COARSE_TOLERANCE = 5e-3


class Descent(eqx.Module):
    """Where a descent stands.

    Attributes:
        T: the pose, rigid.
        scale: factor on the source before the pose.
        T_matched, scale_matched: those of the last match, at which `row` and `width`
            were found.
        row: rows in the target of the last match.
        first_sq_residual: of the first match, of every `stride`-th source point.
        width: kernel width.
        num_steps: steps taken.
        moving: False once a step was small.
        fine: whether the next step matches all source points, as the last one does.
    """

    T: Float[Array, "D D"]
    scale: Float[Array, ""]
    T_matched: Float[Array, "D D"]
    scale_matched: Float[Array, ""]
    row: Int[Array, " n"]
    first_sq_residual: Float[Array, " n"]
    width: Float[Array, ""]
    num_steps: Int[Array, ""]
    moving: Bool[Array, ""]
    fine: Bool[Array, ""]


class Limits(eqx.Module):
    """When a descent ends, and what it counts.

    Attributes:
        max_steps: steps at most.
        with_scale: whether the scale is free.
        farthest: pairs farther apart do not count.
        floor: the kernel width does not fall below.
        tolerance: steps smaller than this, in radians and radii, end the descent.
    """

    max_steps: int = eqx.field(static=True)
    with_scale: bool = eqx.field(static=True)
    farthest: Scalar
    floor: Scalar
    tolerance: Scalar

    def stride(self, num_points: int) -> int:
        """The step between the source points that a descent begins with."""
        if self.max_steps == 1:  # the last step counts all points
            return 1
        return max(1, min(_MAX_STRIDE, num_points // _MIN_COARSE_POINTS))


class Descending(AbstractIteration[tuple[Motion, Scalar], Descent]):
    """The steps of a descent, from a pose and a scale.

    Attributes:
        optimiser: residual x kernel x step.
        problem: the pair.
        limits: when it ends.
    """

    optimiser: LocalOptimiser
    problem: Problem
    limits: Limits

    def init(self, start: tuple[Motion, Scalar]) -> Descent:
        """Nothing matched yet."""
        T, scale = start
        n = self.problem.source.shape[1]
        return Descent(
            T=T,
            scale=scale,
            T_matched=T,
            scale_matched=scale,
            row=jnp.zeros(n, jnp.int32),
            first_sq_residual=jnp.zeros(n, T.dtype),
            width=jnp.asarray(jnp.inf, T.dtype),
            num_steps=jnp.zeros((), jnp.int32),
            moving=jnp.asarray(True),
            fine=jnp.asarray(self.limits.stride(n) == 1),
        )

    def terminate(self, state: Descent) -> Bool[Array, ""]:
        """Whether the last step was small, of all points and at the final width."""
        return ~state.moving

    def fail(self, state: Descent) -> Bool[Array, ""]:
        """Never: a step that is not a number is small."""
        return jnp.asarray(False)

    def step(self, state: Descent) -> Descent:
        """Matches, weighs, moves."""
        optimiser, limits = self.optimiser, self.limits
        found = self._matched(state).within(limits.farthest)
        width = optimiser.kernel.width_of(found.sq_residual, found.mask)
        width = jnp.maximum(jnp.minimum(width, state.width), limits.floor)
        weight = optimiser.weights(found, width)
        growth, scaled = jnp.ones_like(state.scale), found
        if limits.with_scale:
            growth, scaled = fit_scale(optimiser.residual, found, weight)
        T = optimiser.step(state.T, scaled, weight, optimiser.residual)
        T = lie.straightened(T)
        change = jnp.max(jnp.abs(decoupled_error(T, state.T)))
        change = jnp.maximum(change, jnp.abs(growth - 1))
        first = state.num_steps == 0
        falling = width < 0.99 * state.width
        return Descent(
            T=T,
            scale=state.scale * growth,
            T_matched=state.T,
            scale_matched=state.scale,
            row=found.row,
            first_sq_residual=jnp.where(
                first, found.sq_residual, state.first_sq_residual
            ),
            width=width,
            num_steps=state.num_steps + 1,
            moving=~state.fine | (change > limits.tolerance) | falling,
            fine=state.fine
            | (change < _COARSE_TOLERANCE)
            | (state.num_steps + 2 >= limits.max_steps),
        )

    def _matched(self, state: Descent) -> Match:
        """All points or, while steps are large, every so-many-th."""
        n = self.problem.source.shape[1]
        stride = self.limits.stride(n)
        part, num = self.problem, None
        if stride > 1:
            part = _either(state.fine, part, part.every(stride).padded(n))
            num = jnp.where(state.fine, n, -(-n // stride))
        if self.limits.with_scale:
            part = part.scaled(state.scale)
        return match(part, state.T, num=num, coarse=~state.fine, width=state.width)


def _either(fine: Array, problem: Problem, coarse: Problem) -> Problem:
    """One of two problems of the same target."""
    return eqx.tree_at(
        lambda p: (p.source, p.source_normals, p.source_mask),
        problem,
        (
            jnp.where(fine, problem.source, coarse.source),
            jnp.where(fine, problem.source_normals, coarse.source_normals),
            jnp.where(fine, problem.source_mask, coarse.source_mask),
        ),
    )
