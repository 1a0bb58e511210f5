"""How far a registered pose may err: a sandwich taken around it, not at it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import full_matmul, place_among
from jaxreg._core.typing import Motion
from jaxreg.linear.small import eigh
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps import turn_and_shift
from jaxreg.matching.problem import Match, Problem, inner, match
from jaxreg.matching.residuals.gram import along
from jaxreg.neighbours.brute import BruteForce


# Source points that tell how the pulls answer to a displacement: with all of them the
# covariance is the same within 5 %.
_PROBES = 256
# The least answer, as a share of H, that so few points tell from none.
_LEAST_ANSWER = 0.01
# Target points in a cell: about as many as a normal is estimated from. Of large clouds
# more: as many cells as this tell a variance within an eighth.
_CELL, _MOST_CELLS = 8, 128
# Poses around the answer, half of them the other half turned over.
_AROUND = 8
_SIGNS = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND // 2, _MOST_CELLS))
# Source points that are asked at each of them, others at every pose, and of these those
# that tell the answer. With half of them fewer truths are in the regions: of noisy
# lumps 91 in place of 96 %.
_FEW, _FEW_PROBES = 256, 64


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
    sandwich at the root says that the truth is: those that the cells lead to, each
    with a sign drawn at random (a wild bootstrap: Wu 1986).

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
    pulls = _Pulls(optimiser, width, _cells(problem))
    T, weight = T_target_source, optimiser.weights(found, width)
    H, _ = optimiser.residual.normal_equations(found, weight)

    def around(pose: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        """A there, B there, and B of the same points at the root."""
        tangent, number = pose
        few, some = _some(problem, _FEW, number)
        T_there = turn_and_shift(T, tangent)
        there = match(few, T_there, width=width)
        told = optimiser.weights(there, width)
        A = answer(optimiser, few, T_there, there, width, told, _FEW_PROBES)
        here = match(few, T, row=found.row[some])
        asked, num = jnp.sum(few.source_mask), jnp.sum(problem.source_mask)
        whole = (num / jnp.maximum(asked, 1)).astype(A.dtype)
        return whole * A, _scatter(pulls.of(there)), _scatter(pulls.of(here))

    at_root = pulls.of(found)
    A = answer(optimiser, problem, T, found, width, weight)
    inverse = inverse_within(A, H)
    signs = jnp.asarray(_SIGNS, at_root.dtype)
    away = full_matmul(full_matmul(signs, at_root), inverse)
    poses = jnp.concatenate([away, -away]), jnp.arange(_AROUND)
    A, there, here = (jnp.mean(x, axis=0) for x in lax.map(around, poses))
    # Of all points as much as of those that were asked, in deviations of the pose.
    asked = jnp.sum(here * inverse)
    growth = jnp.sum(_scatter(at_root) * inverse) / jnp.where(asked > 0, asked, 1)
    inverse = inverse_within(A, H)
    return full_matmul(inverse, full_matmul(growth * there, inverse))


class _Pulls(NamedTuple):
    """What points pull at a pose by, summed over cells."""

    optimiser: LocalOptimiser
    width: Float[Array, ""]
    cell: Int[Array, " m"]  # of each target point

    def of(self, found: Match) -> Float[Array, "c k"]:
        weight = self.optimiser.weights(found, self.width)
        each = self.optimiser.residual.descents(found) * weight[None]
        return jax.ops.segment_sum(each.T, self.cell[found.row], _MOST_CELLS)


def _scatter(pulls: Float[Array, "c k"]) -> Float[Array, "k k"]:
    """The covariance of their sum, B of `pose_covariance`."""
    return full_matmul(pulls.T, pulls)


def _cells(problem: Problem) -> Int[Array, " m"]:
    """Of each target point the closest of those chosen by their place in the order.

    So cells are the same however the clouds are turned, moved or padded.
    """
    mask, d = problem.index.mask, problem.source.shape[0]
    num = jnp.cumsum(mask)
    place = jnp.maximum(_CELL, -(-num[-1] // _MOST_CELLS)) * jnp.arange(_MOST_CELLS)
    chosen = jnp.minimum(place_among(num, place + 1), len(mask) - 1)
    points = problem.target[:d]
    seeds = BruteForce.build(points[:, chosen].T, place < num[-1])
    return seeds.lookup(points)


def answer(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
    weight: Float[Array, " n"],
    probes: int = _PROBES,
) -> Float[Array, "k k"]:
    """A of `pose_covariance`, from some points displaced to both sides."""
    total = jnp.sum(weight)
    variance = jnp.sum(weight * found.plane_residual**2) / jnp.where(
        total > 0, total, 1
    )
    # An interval of this half length; of matches without error, one above rounding.
    reach = jnp.maximum(jnp.sqrt(3 * variance), 1e-3 * width)
    d = found.source.shape[0]
    few, some = _some(problem, probes)
    here = match(few, T_target_source, row=found.row[some])
    normal = here.source_normal

    def pull(side: Array) -> Array:
        """Along the normals, `reach` away on that side."""
        away = few.source + side * reach * few.source_normals
        there = eqx.tree_at(lambda p: p.source, few, away)
        moved = match(there, T_target_source)
        weight = optimiser.weights(moved, width) * few.source_mask
        return weight * inner(normal, optimiser.residual.descents(moved)[:d])

    sides = jnp.asarray([-1, 1], reach.dtype)
    before, behind = jax.vmap(pull)(sides)  # one search for both
    slope = (before - behind) / (2 * jnp.where(reach > 0, reach, 1))
    slope = slope * jnp.sign(inner(normal, here.normal))
    by_source, by_target = along(normal, here)[:-1], along(here.normal, here)[:-1]
    A = full_matmul(by_source * slope[None], by_target.T)
    # As if all points had been asked, by the share of the weight of those that were.
    asked = jnp.sum(weight[some] * few.source_mask)
    return total / jnp.where(asked > 0, asked, 1) * (A + A.T) / 2


def _some(
    problem: Problem, most: int, number: Array | int = 0
) -> tuple[Problem, Int[Array, " r"]]:
    """Of at most so many source points, spread over the order, others by the number.

    Also their rows. Masked points take no place, so padding does not change them.
    """
    n, mask = len(problem.source_mask), problem.source_mask
    if n <= most:
        return problem, jnp.arange(n)
    count = jnp.cumsum(mask)
    step = jnp.maximum(count[-1], most).astype(problem.source.dtype)
    place = (_AROUND * jnp.arange(most) + number) * (step / (_AROUND * most))
    place = jnp.floor(place).astype(count.dtype)
    rows = jnp.minimum(place_among(count, place + 1), n - 1)
    few = problem.of_rows(rows)
    present = few.source_mask & (place < count[-1])
    return eqx.tree_at(lambda p: p.source_mask, few, present), rows


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
