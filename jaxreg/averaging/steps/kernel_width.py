"""Kernel widths that follow the data: rotation and translation at their own scales."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.likelihood import explained
from jaxreg.averaging.measures import length_scale, nearest_rank, num_held
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import inverse


# The kernel is three standard deviations of the noise wide: right edges lose little
# (the mean is 2 % worse than with the inliers known), wrong ones most.
_DEVIATIONS = 3.0
# Edges with more trust than this are inside.
_INSIDE = 0.05
#: Medians of chi-squared laws by their degrees of freedom.
CHI2_MEDIAN = {1: 0.4549, 2: 1.3863, 3: 2.3660, 6: 5.3481}
_NARROWEST_STEP = 0.25
# A width that changes by less than this share has settled.
_SETTLED = 1e-3


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

    Three of the likeliest deviations, and half of the octave between those compared.
    """
    width = _DEVIATIONS * 2**0.5 * explained(graph, T_world_i, alone=True).deviation
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
    target = _three_deviations(graph, T_world_i, width, scale)
    return jnp.clip(target, _NARROWEST_STEP * width, width)


@eqx.filter_custom_jvp
def followed_width(
    scale: Float[Array, ""],
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    width: Float[Array, "2"],
) -> Float[Array, "2"]:
    """The width of arguments of `annealed_width`, with derivatives if it has settled.

    Then it is three deviations of the edges inside itself, and follows motions, weights
    and poses by that equation; a width that would grow, but may not, is held.
    """
    return width


@followed_width.def_jvp
def _followed_width_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    scale, graph, T_world_i, width = primals
    target, change = eqx.filter_jvp(
        lambda g, T: _three_deviations(g, T, width, scale), primals[1:3], tangents[1:3]
    )
    by_width = jax.jacfwd(lambda w: _three_deviations(graph, T_world_i, w, scale))
    settled = jnp.abs(target - width) < _SETTLED * width
    slope = jnp.where(settled[:, None], by_width(width), 0)
    change = jnp.where(settled, change, 0)
    return width, inverse(jnp.eye(2, dtype=slope.dtype) - slope) @ change


def _three_deviations(
    graph: PoseGraph, T_world_i: Array, width: Array, scale: Array
) -> Float[Array, "2"]:
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
    spare = jnp.maximum(count - (num_held(graph) - 1), 0.25 * count)
    variance = ratio / (1 - ratio) * width**2
    # Noise of many scales would draw the mean to the finest; the median stands.
    inside = (graph.weight > 0) & (trust > _INSIDE)
    middle = jnp.stack(
        [
            nearest_rank(translation, inside, 0.5) / CHI2_MEDIAN[d],
            nearest_rank(rotation, inside, 0.5) / (2 * CHI2_MEDIAN[dof]),
        ]
    )
    variance = jnp.maximum(variance, middle) * count / jnp.maximum(spare, 1e-3)
    floor = 64 * jnp.finfo(w.dtype).eps * jnp.stack([scale, jnp.ones_like(total)])
    # In this order: the root has no derivative where the edges agree exactly.
    return _DEVIATIONS * jnp.sqrt(jnp.maximum(variance, (floor / _DEVIATIONS) ** 2))
