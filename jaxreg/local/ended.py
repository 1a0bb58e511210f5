"""What is said of where a descent ended: its derivatives, evidence and status."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxreg._core.status import Status
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud
from jaxreg.local.descent import Descent, Limits
from jaxreg.local.implicit import Rest, at_rest
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.matching.evidence import LIKELY, Evidence, Witness
from jaxreg.matching.problem import Match, Problem, match
from jaxreg.robust import AbstractKernel


def fits_worse(
    kernel: AbstractKernel,
    end: Descent,
    problem: Problem,
    found: Match,
    limits: Limits,
) -> Bool[Array, ""]:
    """Whether the guess fits better than the match at the end, beyond chance."""
    every = limits.stride(found.mask.shape[0])
    mask = problem.every(every).source_mask
    # A guess that fits exactly is not better than an end that fits up to rounding.
    rounding = (256 * jnp.finfo(end.width.dtype).eps) ** 2

    def loss(sq_residual: Array) -> Array:
        sq = jnp.minimum(sq_residual + rounding, limits.farthest**2)
        return jnp.sum(jnp.where(mask, kernel.rho(sq, end.width), 0))

    last = found.sq_residual[::every]
    # Near the solution matches are exchanged: the sum is known to its standard
    # error, and a guess is not worth more than an end within that.
    chance = lax.rsqrt(jnp.maximum(jnp.sum(mask), 1).astype(end.width.dtype))
    return loss(end.first_sq_residual[: len(last)]) < (1 - chance) * loss(last)


def settled(
    optimiser: LocalOptimiser, problem: Problem, limits: Limits, end: Descent
) -> tuple[Motion, Scalar]:
    """The pose and scale at the end, with their derivatives."""
    end = lax.stop_gradient(end)
    scaled = problem.scaled(end.scale)
    found = match(scaled, end.T, end.row, width=end.width).within(limits.farthest)
    wide = optimiser.kernel.width_of(found.sq_residual, found.mask)
    follows = (end.width > limits.floor) & (wide > 0)
    share = jnp.where(follows, end.width / jnp.where(follows, wide, 1), 0)
    farthest, share = lax.stop_gradient((limits.farthest, share))
    rest = Rest(
        optimiser=optimiser,
        problem=problem,
        width=jnp.where(follows, end.width, limits.floor),
        T=end.T,
        row=end.row,
        scale=end.scale if limits.with_scale else None,
        farthest=farthest,
        follows=share,
    )
    T, scale = at_rest(rest)
    return T, end.scale if scale is None else scale


def evidence_at(
    source: PointCloud, target: PointCloud, T: Motion, scale: Scalar
) -> Evidence:
    """Of the source times a scale at a pose."""
    source, target, T, scale = lax.stop_gradient((source, target, T, scale))
    source = eqx.tree_at(lambda c: c.points, source, scale * source.points)
    return Witness.of_some(source, target).of_pose(T)


def status_of(
    T: Motion,
    status: Int[Array, ""],
    free: Bool[Array, ""],
    evidence: Evidence,
    worse: Bool[Array, ""],
) -> Int[Array, ""]:
    """Of the answer `T`, from that of the loop; the most serious last."""
    status = jnp.where(free, Status.DEGENERATE, status)
    # Steps that have run out say so first: more of them may find evidence. A pose from
    # a guess is one of few: whether surfaces coincide is asked, not what holds them.
    unlikely = evidence.contact < LIKELY
    unlikely &= (status != Status.MAX_STEPS) | (evidence.overlap == 0)
    status = jnp.where(unlikely, Status.LOW_OVERLAP, status)
    status = jnp.where(worse, Status.DIVERGED, status)
    status = jnp.where(jnp.all(jnp.isfinite(T)), status, Status.NON_FINITE)
    return status.astype(jnp.int32)
