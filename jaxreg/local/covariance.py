"""How far a registered pose may err: a sandwich taken around it, not at it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import full_matmul, place_among
from jaxreg._core.typing import Motion
from jaxreg.local.answer import answer_of, displaced, reach_of, some_points
from jaxreg.local.held_directions import inverse_of, whitening
from jaxreg.local.leverage import share_left
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.local.steps import turn_and_shift
from jaxreg.matching.problem import Match, Problem, match
from jaxreg.matching.residuals.gram import along
from jaxreg.neighbours.brute import BruteForce


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
      axes, it is of sums over patches of cells, each for the share of the pose that it
      decides alone. Nothing is assumed about the size of the errors.
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
    T, white = T_target_source, whitening(H)
    pulls = optimiser.residual.descents(found) * weight[None]
    reach, (cell, patch) = reach_of(found, weight, width), _cells(problem)
    at_root = _summed(pulls, cell[found.row])

    def around(number: Array, state: tuple[_Sums, Array]) -> tuple[_Sums, Array]:
        """The sums with those of one more pose, and the inverse of A at the root.

        The root comes first, and the mean of those around it last.
        """
        sums, inverse = state
        away = _led(at_root, inverse)[number - 1]
        T_there = turn_and_shift(T, jnp.where(number > 0, away, 0))
        few, some = some_points(problem, _FEW, number % _AROUND, _AROUND)
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
            lambda A: inverse_of(A / jnp.maximum(number, 1).astype(A.dtype), white),
            lambda _: inverse,
            sums.A,
        )
        return sums, inverse

    zero = jnp.zeros_like(H)
    start = _Sums(zero, zero, zero), zero
    (_, there, here), inverse = control.fori_loop(0, 1 + _AROUND, around, start)
    # Of all points as much as of those that were asked, in deviations of the pose.
    asked = jnp.sum(here * inverse) / _AROUND
    rows = along(found.normal, found)[:-1]
    shared = _shared(at_root, patch, inverse, (rows, weight, cell[found.row]))
    growth = shared / jnp.where(asked > 0, asked, 1)
    return full_matmul(inverse, full_matmul(growth / _AROUND * there, inverse))


class _Sums(NamedTuple):
    """Over poses around the answer: A, B, and B of the same points at the answer."""

    A: Float[Array, "k k"]
    there: Float[Array, "k k"]
    here: Float[Array, "k k"]


def _told(
    optimiser: LocalOptimiser,
    few: Problem,
    T_target_source: Motion,
    reach: Float[Array, ""],
    width: Float[Array, ""],
) -> tuple[Float[Array, "k k"], Float[Array, "k n"], Int[Array, " n"]]:
    """A of these points, their pulls, and their rows in the target: by one search."""
    n, (probes, some) = len(few.source_mask), some_points(few, _FEW_PROBES)
    found = match(few.beside(displaced(probes, reach)), T_target_source, width=width)
    weight = optimiser.weights(found, width)
    pulls = optimiser.residual.descents(found) * weight[None]
    A = answer_of(pulls[:, n:], found.of_rows(some), reach)
    # As if all points had been asked, by the share of the weight of those that were.
    asked = jnp.sum(weight[some] * probes.source_mask)
    A = jnp.sum(weight[:n]) / jnp.where(asked > 0, asked, 1) * A
    return A, pulls[:, :n], found.row[:n]


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
    at_root: Float[Array, "c k"],
    patch: Int[Array, " c"],
    inverse: Float[Array, "k k"],
    points: tuple[Float[Array, "k n"], Float[Array, " n"], Int[Array, " n"]],
) -> Float[Array, ""]:
    """B of the cells in the mean over its axes, or of patches where that is larger.

    What a patch decides alone does not show in its pull, see `share_left`.

    Args:
        at_root: pulls of the cells.
        patch: of each cell.
        inverse: A^-1.
        points: rows (n, x cross n) of the source points, their weights and cells.
    """
    rows, weight, cell = points
    wide = jax.ops.segment_sum(at_root, patch, _PATCHES)
    led = full_matmul(wide, inverse)
    left = share_left(led, rows, weight, patch[cell])
    cells = jnp.sum(_scatter(at_root) * inverse)
    return jnp.maximum(cells, jnp.sum(wide * led / left[:, None]))


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
