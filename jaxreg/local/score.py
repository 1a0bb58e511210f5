"""How well two clouds agree at a pose, without knowing the truth."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Motion
from jaxreg.cloud import PointCloud, levelled
from jaxreg.geometry import lie
from jaxreg.local.problem import Match, Problem, match
from jaxreg.neighbours.base import AbstractIndex


# A point lies on the other surface if the closest sample is within this many sample
# spacings, its plane within 0.2 spacings, and the normals within 30 degrees.
_REACH = 1.0
_PLANE = 0.2
_COSINE_SQ = 0.75


class Score(eqx.Module):
    """Agreement of one cloud with another: share on it and residual of that share."""

    fitness: Float[Array, ""]
    inlier_rmse: Float[Array, ""]
    num_inliers: Int[Array, ""]


def score(
    problem: Problem, T_target_source: Motion, spacing: Float[Array, ""]
) -> Score:
    """The share of the source that lies on the target, and its plane residual.

    Args:
        problem: source and indexed target.
        T_target_source: the pose.
        spacing: distance between samples of the coarser cloud.
    """
    return score_match(match(problem, T_target_source), spacing)


def score_match(found: Match, spacing: Float[Array, ""]) -> Score:
    """`score` of correspondences that are known already."""
    plane = found.plane_residual
    flat = jnp.any(found.normal != 0, axis=0)
    height = jnp.where(flat, plane**2, found.sq_residual)
    inlier = (
        (found.sq_residual < (_REACH * spacing) ** 2)
        & (height < (_PLANE * spacing) ** 2)
        & (found.agreement > _COSINE_SQ)
        & found.mask
    )
    count = jnp.sum(inlier)
    total = jnp.maximum(jnp.sum(found.mask), 1)
    sq = jnp.sum(jnp.where(inlier, height, 0)) / jnp.maximum(count, 1)
    fitness = (count / total).astype(sq.dtype)
    return Score(fitness, jnp.sqrt(sq), count.astype(jnp.int32))


def mutual_overlap(
    there: Float[Array, "*q"], back: Float[Array, "*q"]
) -> Float[Array, "*q"]:
    """How much two clouds share, of the shares of either that lie on the other.

    Their geometric mean: between real scans it tells right poses from wrong ones better
    than the lesser of the two. But at most twice the lesser, as nearly everything fits
    a small patch of a smooth surface.
    """
    return jnp.minimum(jnp.sqrt(there * back), 2 * jnp.minimum(there, back))


def score_both_ways(
    source: PointCloud,
    target: PointCloud,
    source_index: AbstractIndex,
    target_index: AbstractIndex,
    T_target_source: Float[Array, "q D D"],
    spacing: Float[Array, ""],
) -> tuple[Score, Score]:
    """Scores of the source on the target and of the target on the source, at poses."""
    source, target = levelled(source, target)
    forward = Problem.of(source, target, target_index), T_target_source
    backward = Problem.of(target, source, source_index), lie.inverse(T_target_source)

    def scores(way: tuple[Problem, Array]) -> Score:
        problem, T = way
        return lax.map(lambda T: score(problem, T, spacing), T)

    return on_both(scores, forward, backward)
