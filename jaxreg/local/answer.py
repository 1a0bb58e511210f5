"""How pulls on a surface answer to a displacement: A of `pose_covariance`."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import full_matmul, place_among, weighted_sums
from jaxreg._core.typing import Motion
from jaxreg.local.optimiser import LocalOptimiser
from jaxreg.matching.problem import Match, Problem, inner, match
from jaxreg.matching.residuals.gram import along


# Source points that tell how the pulls answer to a displacement: with all of them the
# covariance is the same within 5 %.
_PROBES = 256


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
    reach = reach_of(found, weight, width) / 2
    few, some = some_points(problem, _PROBES)
    moved = match(displaced(few, reach), T_target_source)
    pulls = optimiser.residual.descents(moved) * optimiser.weights(moved, width)[None]
    rest, counted = found.of_rows(some), weight[some] * few.source_mask
    A, asked = answer_of(pulls, rest, reach), jnp.sum(counted)
    H_few, _ = optimiser.residual.normal_equations(rest, counted)
    of_all = jnp.sum(weight) / jnp.where(asked > 0, asked, 1)
    top = jnp.trace(H_few)
    share = jnp.trace(A) / jnp.where(top > 0, top, 1)
    return share * H + of_all * (A - share * H_few)


def reach_of(
    found: Match, weight: Float[Array, " n"], width: Float[Array, ""]
) -> Float[Array, ""]:
    """Half the interval of slopes; of matches without error, one above rounding."""
    sq = found.plane_residual**2
    total, sq = weighted_sums(jnp.stack([jnp.ones_like(sq), sq]), weight)
    sq = sq / jnp.where(total > 0, total, 1)
    return jnp.maximum(jnp.sqrt(3 * sq), 1e-3 * width)


def displaced(problem: Problem, reach: Float[Array, ""]) -> Problem:
    """Its points as far away along their normals, on one side and on the other."""
    away = reach * problem.source_normals
    before, behind = (
        eqx.tree_at(lambda p: p.source, problem, problem.source + x)
        for x in (-away, away)
    )
    return before.beside(behind)


def answer_of(
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


def some_points(
    problem: Problem, most: int, number: Array | int = 0, ways: int = 1
) -> tuple[Problem, Int[Array, " r"]]:
    """At most so many source points, spread over the order; and their rows.

    There are so many ways to choose them, with numbers from 0. Masked points take no
    place, so padding does not change them.
    """
    n, mask = len(problem.source_mask), problem.source_mask
    if n <= most:
        return problem, jnp.arange(n)
    count = jnp.cumsum(mask)
    step = jnp.maximum(count[-1], most).astype(problem.source.dtype)
    place = (ways * jnp.arange(most) + number) * (step / (ways * most))
    place = jnp.floor(place).astype(count.dtype)
    rows = jnp.minimum(place_among(count, place + 1), n - 1)
    few = problem.of_rows(rows)
    present = few.source_mask & (place < count[-1])
    return eqx.tree_at(lambda p: p.source_mask, few, present), rows
