"""How well two clouds agree at a pose, without knowing the truth."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, levelled
from jaxreg.geometry import lie
from jaxreg.matching.problem import Match, Problem, match
from jaxreg.neighbours.base import AbstractIndex


# A point lies on the other surface if the closest sample is within this many sample
# spacings, its plane within 0.2 spacings, and the normals within 30 degrees.
_REACH = 1.0
_PLANE = 0.2
_COSINE_SQ = 0.75
# It contradicts that surface if it is beside a sample, no more than so far along the
# surface, but clearly over or under its plane, with normals within 45 degrees.
_OVER, _FAR_OVER = 0.35, 3.0
_ALIKE_SQ = 0.5
# It speaks against the pose, as much as so many others for it, if it is so many sample
# spacings before the surface that the other scanner saw: that ray was free.
_BEFORE, _AGAINST = 1.5, 100.0


class Score(eqx.Module):
    """Agreement of one cloud with another.

    Attributes:
        fitness: share of the cloud that lies on the other.
        inlier_rmse: residual of that share.
        num_inliers: int32, points in that share.
        num_conflicts: int32, points over or under the other surface.
        num_before: int32, points in what the other scanner saw to be free; zero where
            its viewpoint is not known.
    """

    fitness: Float[Array, "*q"]
    inlier_rmse: Float[Array, "*q"]
    num_inliers: Int[Array, "*q"]
    num_conflicts: Int[Array, "*q"]
    num_before: Int[Array, "*q"]

    @property
    def consistency(self) -> Float[Array, "*q"]:
        """Share of the inliers among the points that agree or conflict.

        Points in free space count many times over: at right poses of scans there are
        none but those of noise, at wrong ones as a rule some in a hundred.
        """
        agree = self.num_inliers.astype(self.fitness.dtype)
        either = agree + self.num_conflicts + _AGAINST * self.num_before
        return agree / jnp.maximum(either, 1)


def score(
    problem: Problem, T_target_source: Motion, spacing: Float[Array, ""]
) -> Score:
    """The share of the source that lies on the target, and its plane residual.

    Args:
        problem: source and indexed target.
        T_target_source: the pose.
        spacing: distance between samples of the coarser cloud.
    """
    found = match(problem, T_target_source)
    return score_match(
        found, spacing, _num_before(problem, T_target_source, found, spacing)
    )


def _num_before(
    problem: Problem, T_target_source: Motion, found: Match, spacing: Scalar
) -> Int[Array, ""]:
    """Source points in the target's free space."""
    if problem.seen is None:
        return jnp.zeros((), jnp.int32)
    moved = found.rotated + lie.translation(T_target_source)[:, None]
    before = problem.seen.depth_before(moved) > _BEFORE * spacing
    return jnp.sum(before & found.mask).astype(jnp.int32)


def agreeing(found: Match, spacing: Float[Array, ""]) -> Bool[Array, " n"]:
    """Which points lie on the other surface."""
    height, _ = _height_sq(found)
    return (
        (found.sq_residual < (_REACH * spacing) ** 2)
        & (height < (_PLANE * spacing) ** 2)
        & (found.agreement > _COSINE_SQ)
        & found.mask
    )


def _height_sq(found: Match) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Squared distances to the matched planes, or points, and where planes are."""
    flat = jnp.any(found.normal != 0, axis=0)
    return jnp.where(flat, found.plane_residual**2, found.sq_residual), flat


def score_match(
    found: Match, spacing: Scalar, num_before: Int[Array, ""] | None = None
) -> Score:
    """`score` of correspondences that are known already."""
    height, flat = _height_sq(found)
    inlier = agreeing(found, spacing)
    conflict = (
        (found.sq_residual - height < (_REACH * spacing) ** 2)
        & (height > (_OVER * spacing) ** 2)
        & (height < (_FAR_OVER * spacing) ** 2)
        & (found.agreement > _ALIKE_SQ)
        & (found.mask & flat)
    )
    count = jnp.sum(inlier)
    total = jnp.maximum(jnp.sum(found.mask), 1)
    sq = jnp.sum(jnp.where(inlier, height, 0)) / jnp.maximum(count, 1)
    fitness = (count / total).astype(sq.dtype)
    num_conflicts = jnp.sum(conflict).astype(jnp.int32)
    count = count.astype(jnp.int32)
    if num_before is None:
        num_before = jnp.zeros_like(count)
    return Score(fitness, jnp.sqrt(sq), count, num_conflicts, num_before)


def mutual_overlap(there: Score, back: Score) -> Float[Array, "*q"]:
    """How much two clouds share, by the scores of either on the other.

    The geometric mean of the shares that lie on the other: between real scans it tells
    right poses from wrong ones better than the lesser of the two. But at most twice the
    lesser, as nearly everything fits a small patch of a smooth surface. Times the
    consistencies: where two scans show the same place they show it at the same height,
    while surfaces that touch by chance part again. (Right pairs of scans of an
    object mostly have a consistency above 0.85, of a cluttered room 0.8; smooth
    surfaces laid on each other wrongly 0.3 to 0.7.)
    """
    least = jnp.minimum(there.fitness, back.fitness)
    share = jnp.minimum(jnp.sqrt(there.fitness * back.fitness), 2 * least)
    return share * there.consistency * back.consistency


def score_both_ways(
    source: PointCloud,
    target: PointCloud,
    source_index: AbstractIndex,
    target_index: AbstractIndex,
    T_target_source: Float[Array, "q D D"],
    used: Bool[Array, " q"],
    spacing: Float[Array, ""],
) -> tuple[Score, Score]:
    """Scores of the source on the target and of the target on the source, at poses.

    Those of poses that are not in use are zero.
    """
    source, target = levelled(source, target)
    forward = Problem.of(source, target, target_index), T_target_source
    backward = Problem.of(target, source, source_index), lie.inverse(T_target_source)

    def scores(way: tuple[Problem, Array]) -> Score:
        problem, T = way

        def one(pose: tuple[Motion, Array]) -> Score:
            return lax.cond(
                pose[1], lambda T: score(problem, T, spacing), _no_score, pose[0]
            )

        return lax.map(one, (T, used))

    return on_both(scores, forward, backward)


def _no_score(T: Motion) -> Score:
    none = jnp.zeros((), jnp.int32)
    return Score(jnp.zeros((), T.dtype), jnp.zeros((), T.dtype), none, none, none)
