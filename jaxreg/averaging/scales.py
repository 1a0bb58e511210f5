"""Kernel widths that follow the data: rotation and translation at their own scales."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.base import length_scale, masked_quantile
from jaxreg.averaging.evidence import SCALES, redundancies
from jaxreg.graph.pose_graph import PoseGraph


# The kernel is three standard deviations of the noise wide: right edges lose little
# (the mean is 2 % worse than with the inliers known), wrong ones most.
_DEVIATIONS = 3.0
# Edges with more trust than this are inside.
_INSIDE = 0.05
#: Medians of chi-squared laws by their degrees of freedom.
CHI2_MEDIAN = {1: 0.4549, 2: 1.3863, 3: 2.3660, 6: 5.3481}
_NARROWEST_STEP = 0.25


def gaussian_trust(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], width: Float[Array, "2"]
) -> Float[Array, " e"]:
    """G_sigma of the residual of each edge (Eq. 12); widths are (length, angle)."""
    rotation, translation = graph.differences(T_world_i)
    sq = translation / width[0] ** 2 + rotation / (2 * width[1] ** 2)
    return jnp.exp(-sq / 2)


def first_width(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"]
) -> Float[Array, "2"]:
    """A width that sees the right edges from the start, and few others.

    Four times the scale at which the edges that agree, beyond those of a tree, say
    most: fine agreement says more than coarse. Wrong motions that agree with each
    other roughly draw a start to themselves under a wider kernel.
    """
    found = redundancies(graph, T_world_i)
    rank = jnp.arange(1, len(SCALES) + 1, dtype=found.dtype)
    width = 4 * jnp.asarray(SCALES, found.dtype)[jnp.argmax(rank * found)]
    return jnp.stack([width * length_scale(graph), width])


def annealed_width(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    width: Float[Array, "2"],
    scale: Float[Array, ""],
) -> Float[Array, "2"]:
    """The next width: three deviations of the edges inside the present one.

    Never wider than before, nor narrower than a quarter of it. The weighted mean square
    v of Gaussian noise of variance s^2 under a Gaussian kernel of width w is
    1 / (1/s^2 + 1/w^2), which is solved for s^2; s^2 is enlarged for the unknowns that
    the poses take up.
    `scale` is the `length_scale` of the graph.
    """
    d = graph.dim
    rotation, translation = graph.differences(T_world_i)
    trust = gaussian_trust(graph, T_world_i, width)
    w = graph.weight * trust
    total = jnp.maximum(jnp.sum(w), jnp.finfo(w.dtype).tiny)
    dof = d * (d - 1) // 2
    v = jnp.stack([jnp.sum(w * translation) / d, jnp.sum(w * rotation) / (2 * dof)])
    v = v / total
    ratio = jnp.minimum(v / width**2, 0.9)
    count = jnp.sum(jnp.where(graph.weight > 0, trust, 0))
    spare = jnp.maximum(count - (graph.num_poses - 1), 0.25 * count)
    variance = ratio / (1 - ratio) * width**2
    # Noise of many scales would draw the mean to the finest; the median stands.
    inside = (graph.weight > 0) & (trust > _INSIDE)
    middle = jnp.stack(
        [
            masked_quantile(translation, inside, 0.5) / CHI2_MEDIAN[d],
            masked_quantile(rotation, inside, 0.5) / (2 * CHI2_MEDIAN[dof]),
        ]
    )
    variance = jnp.maximum(variance, middle) * count / jnp.maximum(spare, 1e-3)
    floor = 64 * jnp.finfo(w.dtype).eps * jnp.stack([scale, jnp.ones_like(total)])
    target = jnp.maximum(_DEVIATIONS * jnp.sqrt(variance), floor)
    return jnp.clip(target, _NARROWEST_STEP * width, width)
