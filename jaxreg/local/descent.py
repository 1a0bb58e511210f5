"""The loop of a local registration: match, weigh, step, until nothing moves.

From coarse to fine: while steps are large, a subset of the source is matched, by the
quickest look-up that the index has (a table); then all points by the index itself.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.adjoint import AbstractAdjoint
from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation
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

    def within_reach(self, found: Match) -> Match:
        """The match with the pairs that are too far apart masked."""
        near = found.sq_residual <= self.farthest**2
        return eqx.tree_at(
            lambda m: (m.mask, m.agreement),
            found,
            (found.mask & near, jnp.where(near, found.agreement, 0)),
        )


def descend(
    optimiser: LocalOptimiser,
    problem: Problem,
    init: Motion,
    scale: Scalar,
    limits: Limits,
    adjoint: AbstractAdjoint,
) -> Descent:
    """Descends from a pose and a scale; `adjoint` is that of the loop."""
    n = problem.source.shape[1]
    step = limits.stride(n)
    coarse = problem.every(step).padded(n)

    def body(state: Descent) -> Descent:
        part, num = problem, None
        if step > 1:
            part = _either(state.fine, problem, coarse)
            num = jnp.where(state.fine, n, -(-n // step))
        if limits.with_scale:
            part = part.scaled(state.scale)
        found = match(part, state.T, num=num, coarse=~state.fine)
        found = limits.within_reach(found)
        width = optimiser.kernel.width_of(found.sq_residual, found.mask)
        width = jnp.maximum(jnp.minimum(width, state.width), limits.floor)
        weight = optimiser.weights(found, width)
        growth, scaled = jnp.ones_like(state.scale), found
        if limits.with_scale:
            growth, scaled = fit_scale(optimiser.residual, found, weight)
        T = optimiser.step(state.T, scaled, weight, optimiser.residual)
        T = lie.compose(nearest_rotation(lie.rotation(T)), lie.translation(T))
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

    return adjoint.while_loop(
        lambda s: s.moving & (s.num_steps < limits.max_steps),
        body,
        _before(init, scale, n, fine=step == 1),
        limits.max_steps,
    )


def _before(init: Motion, scale: Scalar, n: int, *, fine: bool) -> Descent:
    return Descent(
        T=init,
        scale=scale,
        T_matched=init,
        scale_matched=scale,
        row=jnp.zeros(n, jnp.int32),
        first_sq_residual=jnp.zeros(n, init.dtype),
        width=jnp.asarray(jnp.inf, init.dtype),
        num_steps=jnp.zeros((), jnp.int32),
        moving=jnp.asarray(True),
        fine=jnp.asarray(fine),
    )


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
