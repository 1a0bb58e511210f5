"""How far a registered pose may err: a sandwich taken around it, not at it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import full_matmul, place_among, weighted_sums
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
# Parts of the target of some cells each: as few as tell a variance within a third along
# one axis, an eighth in the mean over six.
_PATCHES = 16
# Poses around the answer, half of them the other half turned over.
_AROUND = 8
_SIGNS = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND // 2, _MOST_CELLS))
# Source points that are asked at each of them, others at every pose, and of these those
# that tell the answer. With 128 and 32 fewer truths are in the regions: of noisy lumps
# 91 in place of 96 %.
_FEW, _FEW_PROBES = 256, 128


def pose_covariance(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
    weight: Float[Array, " n"],
    H: Float[Array, "k k"],
) -> Float[Array, "k k"]:
    """Of the error of a pose that solves sum_i w_i J_i^T r_i = 0, in its tangent.

    The sandwich A^-1 B A^-T of estimating equations (Huber 1967), where

    * B is the covariance of the sum. Source points that share a target point share its
      error, neighbours share errors of their normals, and along the border of a partial
      overlap all err to one side. So terms are summed over cells of some target points
      before they are squared (Liang and Zeger 1986). Real scans are warped, too, and
      err alike over wider parts: B is raised by how much larger, in the mean over its
      axes, it is of sums over patches of cells. Nothing is assumed about the size of
      the errors.
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
        weight: of each match there.
        H: the Gauss-Newton matrix there.

    Gradients: of no use, as the matches jump; `Curvature` cuts them.
    """
    T, white = T_target_source, _whitening(H)
    pulls = optimiser.residual.descents(found) * weight[None]
    reach, (cell, patch) = _reach(found, weight, width), _cells(problem)
    at_root = _summed(pulls, cell[found.row])

    def around(number: Array, state: tuple[_Sums, Array]) -> tuple[_Sums, Array]:
        """The sums with those of one more pose, and the inverse of A at the root.

        The root comes first, and the mean of those around it last.
        """
        sums, inverse = state
        away = _led(at_root, inverse)[number - 1]
        T_there = turn_and_shift(T, jnp.where(number > 0, away, 0))
        few, some = _some(problem, _FEW, number % _AROUND)
        A, there, row = _told(optimiser, few, T_there, reach, width)
        asked, num = jnp.sum(few.source_mask), jnp.sum(problem.source_mask)
        A = (num / jnp.maximum(asked, 1)).astype(A.dtype) * A
        here = jnp.where(few.source_mask, pulls[:, some], 0)
        there = _scatter(_summed(there, cell[row]))
        here = _scatter(_summed(here, cell[found.row[some]]))
        new = _Sums(A, there, here)
        sums = jax.tree.map(lambda s, x: jnp.where(number > 1, s + x, x), sums, new)
        inverse = control.cond(
            (number == 0) | (number == _AROUND),
            lambda A: _inverse(A / jnp.maximum(number, 1).astype(A.dtype), white),
            lambda _: inverse,
            sums.A,
        )
        return sums, inverse

    zero = jnp.zeros_like(H)
    start = _Sums(zero, zero, zero), zero
    (_, there, here), inverse = control.fori_loop(0, 1 + _AROUND, around, start)
    # Of all points as much as of those that were asked, in deviations of the pose.
    asked, shared = jnp.sum(here * inverse) / _AROUND, _shared(at_root, patch, inverse)
    growth = shared / jnp.where(asked > 0, asked, 1)
    return full_matmul(inverse, full_matmul(growth / _AROUND * there, inverse))


class _Sums(NamedTuple):
    """Over poses around the answer: A, B, and B of the same points at the answer."""

    A: Float[Array, "k k"]
    there: Float[Array, "k k"]
    here: Float[Array, "k k"]


def _led(
    at_root: Float[Array, "c k"], inverse: Float[Array, "k k"]
) -> Float[Array, "r k"]:
    """Where cells lead to that pull either way, each with a sign of its own."""
    signs = jnp.asarray(_SIGNS, at_root.dtype)
    away = full_matmul(full_matmul(signs, at_root), inverse)
    return jnp.concatenate([away, -away])


def _summed(pulls: Float[Array, "k n"], cell: Int[Array, " n"]) -> Float[Array, "c k"]:
    return jax.ops.segment_sum(pulls.T, cell, _MOST_CELLS)


def _scatter(pulls: Float[Array, "c k"]) -> Float[Array, "k k"]:
    """The covariance of their sum, B of `pose_covariance`."""
    return full_matmul(pulls.T, pulls)


def _shared(
    at_root: Float[Array, "c k"], patch: Int[Array, " c"], inverse: Float[Array, "k k"]
) -> Float[Array, ""]:
    """B of the cells in the mean over its axes, or of patches where that is larger.

    Patches sum to zero at the root, so one of them tells nothing.
    """
    wide = jax.ops.segment_sum(at_root, patch, _PATCHES)
    own, wide = (jnp.sum(_scatter(x) * inverse) for x in (at_root, wide))
    return jnp.maximum(own, _PATCHES / (_PATCHES - 1) * wide)


def _cells(problem: Problem) -> tuple[Int[Array, " m"], Int[Array, " c"]]:
    """The cell of each target point, and the patch of each cell.

    Of the closest of points chosen by their place in the order, and of every eighth of
    these. So they are the same however the clouds are turned, moved or padded.
    """
    mask, d = problem.index.mask, problem.source.shape[0]
    num = jnp.cumsum(mask)
    place = jnp.maximum(_CELL, -(-num[-1] // _MOST_CELLS)) * jnp.arange(_MOST_CELLS)
    chosen = jnp.minimum(place_among(num, place + 1), len(mask) - 1)
    points = problem.target[:d]
    seeds, present = points[:, chosen], place < num[-1]
    few = slice(None, None, _MOST_CELLS // _PATCHES)
    cells = BruteForce.build(seeds.T, present)
    patches = BruteForce.build(seeds[:, few].T, present[few])
    return cells.lookup(points), patches.lookup(seeds)


def answer(
    optimiser: LocalOptimiser,
    problem: Problem,
    T_target_source: Motion,
    found: Match,
    width: Float[Array, ""],
    weight: Float[Array, " n"],
    H: Float[Array, "k k"],
) -> Float[Array, "k k"]:
    """A of `pose_covariance`, from some points displaced to both sides.

    A of a few hundred points is too small in some directions and too large in others,
    and so is their H. So they tell which share of their H it is, and how it differs
    from that; all points tell H. The interval of the slopes is half of that in
    `pose_covariance`: over the whole of it they are a tenth too small for motions that
    were found from the poses of all.
    """
    reach = _reach(found, weight, width) / 2
    few, some = _some(problem, _PROBES)
    moved = match(_displaced(few, reach), T_target_source)
    pulls = optimiser.residual.descents(moved) * optimiser.weights(moved, width)[None]
    rest, counted = found.of_rows(some), weight[some] * few.source_mask
    A, asked = _answer(pulls, rest, reach), jnp.sum(counted)
    H_few, _ = optimiser.residual.normal_equations(rest, counted)
    of_all = jnp.sum(weight) / jnp.where(asked > 0, asked, 1)
    top = jnp.trace(H_few)
    share = jnp.trace(A) / jnp.where(top > 0, top, 1)
    return share * H + of_all * (A - share * H_few)


def _told(
    optimiser: LocalOptimiser,
    few: Problem,
    T_target_source: Motion,
    reach: Float[Array, ""],
    width: Float[Array, ""],
) -> tuple[Float[Array, "k k"], Float[Array, "k n"], Int[Array, " n"]]:
    """A of these points, their pulls, and their rows in the target: by one search."""
    n, (probes, some) = len(few.source_mask), _some(few, _FEW_PROBES)
    found = match(few.beside(_displaced(probes, reach)), T_target_source, width=width)
    weight = optimiser.weights(found, width)
    pulls = optimiser.residual.descents(found) * weight[None]
    A = _answer(pulls[:, n:], found.of_rows(some), reach)
    # As if all points had been asked, by the share of the weight of those that were.
    asked = jnp.sum(weight[some] * probes.source_mask)
    A = jnp.sum(weight[:n]) / jnp.where(asked > 0, asked, 1) * A
    return A, pulls[:, :n], found.row[:n]


def _reach(
    found: Match, weight: Float[Array, " n"], width: Float[Array, ""]
) -> Float[Array, ""]:
    """Half the interval of slopes; of matches without error, one above rounding."""
    sq = found.plane_residual**2
    total, sq = weighted_sums(jnp.stack([jnp.ones_like(sq), sq]), weight)
    sq = sq / jnp.where(total > 0, total, 1)
    return jnp.maximum(jnp.sqrt(3 * sq), 1e-3 * width)


def _displaced(problem: Problem, reach: Float[Array, ""]) -> Problem:
    """Its points as far away along their normals, on one side and on the other."""
    away = reach * problem.source_normals
    before, behind = (
        eqx.tree_at(lambda p: p.source, problem, problem.source + x)
        for x in (-away, away)
    )
    return before.beside(behind)


def _answer(
    pulls: Float[Array, "k two_n"], at_rest: Match, reach: Float[Array, ""]
) -> Float[Array, "k k"]:
    """A of points at rest, from the pulls on either side."""
    normal, d = at_rest.source_normal, len(at_rest.normal)
    before, behind = jnp.split(pulls[:d], 2, axis=1)
    slope = inner(normal, before - behind) / (2 * jnp.where(reach > 0, reach, 1))
    slope = slope * jnp.sign(inner(normal, at_rest.normal))
    by_source, by_target = (along(x, at_rest)[:-1] for x in (normal, at_rest.normal))
    A = full_matmul(by_source * slope[None], by_target.T)
    return (A + A.T) / 2


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


def after_steps(
    A: Float[Array, "k k"], H: Float[Array, "k k"], num: int
) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    """What Gauss-Newton steps make of pulls g and of a displacement x at the start.

    Steps x <- x + H^-1 (g - A x) lead to (1 - S) x + G g. In the directions that H
    holds, with A from 0.01 to 1 times H; where A is little, few steps lead nowhere.

    Returns:
        G, which is A^-1 where A is large, and S.
    """
    white, share = _shares(A, _whitening(H))
    undone = 1 - (1 - share) ** num
    gain = full_matmul(white * (undone / share)[None], white.T)
    return gain, full_matmul(full_matmul(white * undone[None], white.T), H)


def _whitening(H: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """W with W^T H W = I in the directions that H holds; zero in the others."""
    diagonal = jnp.diagonal(H)
    unit = jnp.where(diagonal > 0, lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    value, vector = eigh(H * unit[:, None] * unit[None])
    held = value > len(H) * jnp.finfo(H.dtype).eps * value[-1]
    root = jnp.where(held, lax.rsqrt(jnp.where(held, value, 1)), 0)
    return unit[:, None] * vector * root[None]


def _inverse(A: Float[Array, "k k"], white: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """A^-1 in the directions that H holds, given the `_whitening` of H."""
    white, share = _shares(A, white)
    return full_matmul(white / share[None], white.T)


def _shares(
    A: Float[Array, "k k"], white: Float[Array, "k k"]
) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
    """Directions W with W^T H W = I in which A is diagonal, from 0.01 to 1 times H."""
    value, vector = eigh(full_matmul(white.T, full_matmul(A, white)))
    return full_matmul(white, vector), jnp.clip(value, _LEAST_ANSWER, 1)
