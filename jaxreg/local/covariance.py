"""How far a registered pose may err: a sandwich taken around it, not at it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.typing import Motion
from jaxreg.linear.small import eigh
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps.base import full_matmul, turn_and_shift
from jaxreg.matching.problem import Match, Problem, match, sum_rows
from jaxreg.matching.residuals.gram import along
from jaxreg.neighbours.order import hilbert_order


# Source points that tell how the pulls answer to a displacement: with all of them the
# covariance is the same within 5 %.
_PROBES = 256
# The least answer, as a share of H, that so few points tell from none.
_LEAST_ANSWER = 0.01
# Target points in a cell: about as many as a normal is estimated from.
_CELL = 8
# The answer, and poses around it, one deviation away along every axis, and balanced.
_AROUND = np.array(
    [[0] * 6]
    + [[(-1) ** (row & col).bit_count() for col in range(1, 7)] for row in range(8)]
)


def pose_covariance(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
) -> Float[Array, "k k"]:
    """Of the error of a pose that solves sum_i w_i J_i^T r_i = 0, in its tangent.

    The sandwich A^-1 B A^-T of estimating equations (Huber 1967), where

    * B is the covariance of the sum. Source points that share a target point share its
      error, neighbours share errors of their normals, and along the border of a partial
      overlap all err to one side. So terms are summed over cells of some target points
      before they are squared (Liang and Zeger 1986). Nothing is assumed about the size
      of the errors.
    * A is minus the derivative of the sum, with the closest points found anew and
      weighed anew: those that noise brought near answer less to a motion than H, which
      holds matches and weights, says (a fifth as much at a noise of 0.4 sample
      spacings). A motion that slides a surface along itself only exchanges samples, so
      a point answers to its displacement along the normal alone, by a factor a_i:
      A = sum_i a_i (n_q, x cross n_q) (n_p, x cross n_p)^T. With normals n_p of the
      source and n_q of the target, whose errors are independent, the product has the
      mean of that of the true normals; squares of either would take their noise for
      information (errors in variables: Fuller 1987).

    The sum is no smooth function of the pose. So a_i is the slope between displacements
    to either side, on the scale of the errors (Zeng and Lin 2008): its mean over an
    interval, whose uniform distribution has the standard deviation of the distances to
    the matched planes. And at the root that was found pulls are smaller, and answer
    more, than elsewhere, as the root was chosen for its matches; the truth is a pose
    near by that was not. So A and B are means over poses as far from the root as the
    sandwich at the root says that the truth is.

    In the directions that H leaves free it is zero. It does not know of a bias that all
    points share. How often the truth is in its regions: bench/studies/coverage.md.

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
    cell = _cells(problem)

    def parts(T: Motion, found: Match) -> tuple[Array, Array]:
        weight = optimiser.weights(found, width)
        A = answer(optimiser, problem, T, found, width, weight)
        return A, _scatter(optimiser, found, weight, cell)

    def sandwich_of(A: Array, B: Array) -> Array:
        inverse = inverse_within(A, H)
        return full_matmul(inverse, full_matmul(B, inverse))

    def at_side(number: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        root, A, B = state
        T = turn_and_shift(T_target_source, full_matmul(root, sides[number])[:, 0])
        here = parts(T, match(problem, T, width=width))
        return control.cond(
            number == 0,  # at the answer itself, which says how far around it lies
            lambda: (_root(sandwich_of(*here)), A, B),
            lambda: (root, A + here[0], B + here[1]),
        )

    sides = jnp.asarray(_AROUND[:, : len(H)], H.dtype)[..., None]
    # One loop, so that searches are compiled once.
    none = jnp.zeros_like(H)
    _, A, B = control.fori_loop(0, len(sides), at_side, (none, none, none))
    num = len(sides) - 1
    return sandwich_of(A / num, B / num)


def _cells(problem: Problem) -> Int[Array, " m"]:
    """Of each target point: some that follow each other along a curve through all."""
    m, d = len(problem.target), problem.source.shape[0]
    order = hilbert_order(problem.target[:, :d], jnp.ones(m, bool))
    place = jnp.arange(m, dtype=jnp.int32)
    return jnp.zeros(m, jnp.int32).at[order].set(place) // _CELL


def _scatter(
    optimiser: LocalOptimiser, found: Match, weight: Array, cell: Int[Array, " m"]
) -> Float[Array, "k k"]:
    """B of `pose_covariance`."""
    pulls = optimiser.residual.descents(found) * weight
    pulls = jax.ops.segment_sum(pulls.T, cell[found.row], len(cell))
    return full_matmul(pulls.T, pulls)


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
    d, n = found.rotated.shape
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
        return weight * sum_rows(normal * optimiser.residual.descents(moved)[:d])

    sides = jnp.asarray([-1, 1], reach.dtype)
    before, behind = jax.vmap(pull)(sides)  # one search for both
    slope = (before - behind) / (2 * jnp.where(reach > 0, reach, 1))
    slope = slope * jnp.sign(sum_rows(normal * here.normal))
    by_source, by_target = along(normal, here)[:-1], along(here.normal, here)[:-1]
    A = full_matmul(by_source * slope, by_target.T)
    # As if all points had been asked, by the share of the weight of those that were.
    asked = jnp.sum(weight[::every])
    return total / jnp.where(asked > 0, asked, 1) * (A + A.T) / 2


def inverse_within(
    A: Float[Array, "k k"], H: Float[Array, "k k"]
) -> Float[Array, "k k"]:
    """A^-1 in the directions that H holds, with A from 0.01 to 1 times H."""
    diagonal = jnp.diagonal(H)
    unit = jnp.where(diagonal > 0, lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    value, vector = eigh(H * unit[:, None] * unit)
    held = value > len(H) * jnp.finfo(H.dtype).eps * value[-1]
    root = jnp.where(held, lax.rsqrt(jnp.where(held, value, 1)), 0)
    white = unit[:, None] * vector * root  # white.T H white = I
    share = full_matmul(white.T, full_matmul(A, white))
    value, vector = eigh(share)
    white = full_matmul(white, vector)
    return full_matmul(white / jnp.clip(value, _LEAST_ANSWER, 1), white.T)


def _root(C: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """L with L L^T = C, of any units."""
    diagonal = jnp.diagonal(C)
    unit = jnp.sqrt(jnp.maximum(diagonal, 0))
    scale = jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1), 0)
    value, vector = eigh(C * scale[:, None] * scale)
    return unit[:, None] * vector * jnp.sqrt(jnp.maximum(value, 0))
