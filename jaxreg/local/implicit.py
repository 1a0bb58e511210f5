"""Derivatives of a registered pose by the implicit function theorem.

Where a descent ends, the pulls of the matched points balance: b = 0, with weights by
the kernel. The pose is differentiated through that equation, not through the loop.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Scalar
from jaxreg.linear.small import eigh, least_norm_solution
from jaxreg.local.descent import Descent, Limits
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps import turn_and_shift
from jaxreg.local.steps.base import full_matmul
from jaxreg.matching.problem import Problem, match


# Singular values below this share of the largest, in units of rounding, are free.
_FREE = 100


class _End(eqx.Module):
    """What the balance at the end depends on; `found` is held."""

    optimiser: LocalOptimiser
    problem: Problem
    width: Scalar
    limits: Limits
    found: Descent


def stationary(
    optimiser: LocalOptimiser,
    problem: Problem,
    width: Scalar,
    limits: Limits,
    end: Descent,
) -> tuple[Motion, Scalar]:
    """`end.T` and `end.scale`, with the derivatives of the pose that balances.

    Args:
        optimiser: residual, kernel and step; the first two may be differentiated.
        problem: the pair, of which source and target may be.
        width: kernel width at the end, which may be.
        limits: those of the descent.
        end: where it ended; the correspondences are its rows.
    """
    end = jax.lax.stop_gradient(end)
    x = _correction(_End(optimiser, problem, width, limits, end))
    k = x.shape[0] - limits.with_scale
    T = turn_and_shift(end.T, x[:k])
    return T, end.scale * jnp.exp(x[k]) if limits.with_scale else end.scale


@eqx.filter_custom_jvp
def _correction(at: _End) -> Float[Array, " k"]:
    """The tangent from the end to the balance: zero, with derivatives."""
    d = at.problem.source.shape[0]
    k = 3 * (d - 1) + at.limits.with_scale
    zero = jnp.zeros(k, at.problem.source.dtype)
    # A constant has no lanes under `vmap`, but its tangent has: JAX mixes them up.
    return jnp.where(jnp.isnan(at.found.T[0, 0]), -zero, zero)


@_correction.def_jvp
def _correction_jvp(primals: tuple[_End], tangents: tuple) -> tuple[Array, Array]:
    (at,), zero = primals, _correction(*primals)
    along = eqx.filter_jvp(lambda at: _pulls(zero, at), primals, tangents)[1]
    if along is None:  # nothing that is differentiated has an influence
        return zero, jnp.zeros_like(zero)
    A = jax.jacfwd(lambda x: _pulls(x, at))(zero)
    # Directions that the data leave free do not follow.
    return zero, -least_norm_solution(A, along, _FREE * float(jnp.finfo(A.dtype).eps))


def _with_turning_normals(problem: Problem) -> Problem:
    """Normals that turn with their cloud as a whole, each held within it.

    So the pose follows a rigid motion of either cloud exactly.
    """
    d = problem.source.shape[0]
    source = _turned(problem.source, problem.source_normals)
    points, normals = problem.target[:, :d].T, problem.target[:, d:].T
    target = jnp.concatenate([points, _turned(points, normals)]).T
    return eqx.tree_at(
        lambda p: (p.source_normals, p.target), problem, (source, target)
    )


def _turned(
    points: Float[Array, "d n"], normals: Float[Array, "d n"]
) -> Float[Array, "d n"]:
    """The same normals, with the derivative of the rotation that fits the points'.

    Its tangent W is skew and least in sum |dx - W x|^2: W C + C W = B - B^T with
    C = sum x x^T and B = sum dx x^T.
    """
    still = jax.lax.stop_gradient(points)
    known = jnp.any(normals != 0, axis=0).astype(points.dtype)
    middle = jnp.sum(known * still, axis=1) / jnp.maximum(jnp.sum(known), 1)
    x = known * (still - middle[:, None])
    B = full_matmul(points - still, x.T)
    spread, axes = eigh(full_matmul(x, x.T))
    skew = full_matmul(axes.T, full_matmul(B - B.T, axes))
    total = spread[:, None] + spread[None, :]
    floor = _FREE * jnp.finfo(spread.dtype).eps * spread[-1]
    skew = jnp.where(total > floor, skew / jnp.where(total > floor, total, 1), 0)
    turn = full_matmul(axes, full_matmul(skew, axes.T))
    return normals + full_matmul(turn, normals)


def _pulls(x: Float[Array, " k"], at: _End) -> Float[Array, " k"]:
    """b, and the pull on the scale if that is free, at a tangent from the end."""
    d = at.problem.source.shape[0]
    T = turn_and_shift(at.found.T, x[: 3 * (d - 1)])
    scale = at.found.scale
    if at.limits.with_scale:
        scale = scale * jnp.exp(x[-1])
    found = match(_with_turning_normals(at.problem).scaled(scale), T, at.found.row)
    found = at.limits.within_reach(found)
    weight = at.optimiser.weights(found, at.width)
    residual = at.optimiser.residual
    b = jnp.sum(weight * residual.descents(found), axis=1)
    if not at.limits.with_scale:
        return b

    def energy(s: Array) -> Array:
        grown = eqx.tree_at(
            lambda m: m.residual, found, found.residual - s * found.rotated
        )
        return residual.energy(grown, weight)

    zero, one = jnp.zeros_like(at.width), jnp.ones_like(at.width)
    slope = jax.jvp(energy, (zero,), (one,))[1]
    return jnp.concatenate([b, -slope[None]])
