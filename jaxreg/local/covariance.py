"""How far a registered pose may err."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg._core.typing import Motion
from jaxreg.linear.small import eigh
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.matching.problem import Match, Problem, inner, match
from jaxreg.matching.residuals.gram import along


# Source points that tell how the pulls answer to a displacement: with all of them the
# covariance is the same within 5 %.
_PROBES = 256
# The least answer, as a share of H, that so few points tell from none.
_LEAST_ANSWER = 0.01


def pose_covariance(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
) -> Float[Array, "k k"]:
    """Of the error of a pose that solves sum_i w_i J_i^T r_i = 0, in its tangent.

    The sandwich A^-1 B A^-T of estimating equations (Huber 1967), where

    * B is the covariance of the sum. The source points that share a target point share
      its error, so their terms are summed before they are squared (Liang and Zeger
      1986). Nothing is assumed about the size of the errors.
    * A is minus the derivative of the sum, with the closest points found anew and
      weighed anew: those that noise brought near answer less to a motion than H, which
      holds matches and weights, says (a fifth as much at a noise of 0.4 sample
      spacings). A motion that slides a surface along itself only exchanges samples, so
      a point answers to its displacement along the normal alone, by a factor a_i:
      A = sum_i a_i (n_q, x cross n_q) (n_p, x cross n_p)^T. With normals n_p of the
      source and n_q of the target, whose errors are independent, the product has the
      mean of that of the true normals; squares of either would take their noise for
      information (errors in variables: Fuller 1987).

    The sum is no smooth function of the pose, and its slope at the root found is
    steeper than elsewhere, as the root adapts to this sample. So a_i is the slope
    between displacements to either side, on the scale of the errors (Zeng and Lin
    2008): its mean over an interval, whose uniform distribution has the standard
    deviation of the distances to the matched planes.

    In the directions that H leaves free it is zero. It does not know of a bias, which
    every point may have alike, as at the border of a partial overlap, nor of other
    roots near by: at a noise of 0.4 spacings `ICP` has several, and three quarters of
    the truths are in its region of 95 % (of those of 0.2 or less 92 to 95 %; measured
    in notebooks/01_registration_uncertainty.ipynb). What would mend most of it, and why
    it is not here: bench/studies/coverage.md.

    Args:
        optimiser: whose residual and kernel are solved for.
        problem: source and indexed target.
        T_target_source: the pose.
        found: the match there.
        width: kernel width.

    Gradients: of no use, as the matches jump; `Curvature` cuts them.
    """
    weight = optimiser.weights(found, width)
    H, _ = optimiser.residual.normal_equations(found, weight)
    pulls = optimiser.residual.descents(found) * weight[None]
    pulls = jax.ops.segment_sum(pulls.T, found.row, problem.target.shape[1])
    meat = full_matmul(pulls.T, pulls)
    A = answer(optimiser, problem, T_target_source, found, width, weight)
    inverse = inverse_within(A, H)
    return full_matmul(inverse, full_matmul(meat, inverse))


def answer(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
    weight: Float[Array, " n"],
) -> Float[Array, "k k"]:
    """A of `pose_covariance`, from some points displaced to both sides."""
    total = jnp.sum(weight)
    variance = jnp.sum(weight * found.plane_residual**2) / jnp.where(
        total > 0, total, 1
    )
    # An interval of this half length; of matches without error, one above rounding.
    reach = jnp.maximum(jnp.sqrt(3 * variance), 1e-3 * width)
    d, n = found.source.shape
    every = max(1, n // _PROBES)
    few = problem.every(every)
    here = match(few, T_target_source, row=found.row[::every])
    normal = here.source_normal

    def pull(side: Array) -> Array:
        """Along the normals, `reach` away on that side."""
        away = few.source + side * reach * few.source_normals
        there = eqx.tree_at(lambda p: p.source, few, away)
        moved = match(there, T_target_source)
        weight = optimiser.weights(moved, width) * found.mask[::every]
        return weight * inner(normal, optimiser.residual.descents(moved)[:d])

    sides = jnp.asarray([-1, 1], reach.dtype)
    before, behind = jax.vmap(pull)(sides)  # one search for both
    slope = (before - behind) / (2 * jnp.where(reach > 0, reach, 1))
    slope = slope * jnp.sign(inner(normal, here.normal))
    by_source, by_target = along(normal, here)[:-1], along(here.normal, here)[:-1]
    A = full_matmul(by_source * slope[None], by_target.T)
    # As if all points had been asked, by the share of the weight of those that were.
    asked = jnp.sum(weight[::every])
    return total / jnp.where(asked > 0, asked, 1) * (A + A.T) / 2


def inverse_within(
    A: Float[Array, "k k"], H: Float[Array, "k k"]
) -> Float[Array, "k k"]:
    """A^-1 in the directions that H holds, with A from 0.01 to 1 times H."""
    diagonal = jnp.diagonal(H)
    unit = jnp.where(diagonal > 0, lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    value, vector = eigh(H * unit[:, None] * unit[None])
    held = value > len(H) * jnp.finfo(H.dtype).eps * value[-1]
    root = jnp.where(held, lax.rsqrt(jnp.where(held, value, 1)), 0)
    white = unit[:, None] * vector * root[None]  # white.T H white = I
    share = full_matmul(white.T, full_matmul(A, white))
    value, vector = eigh(share)
    white = full_matmul(white, vector)
    share = jnp.clip(value, _LEAST_ANSWER, 1)
    return full_matmul(white / share[None], white.T)
