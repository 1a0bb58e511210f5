"""Kernel widths that follow the data: rotation and translation at their own scales."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.chi_squared import exceeded_with
from jaxreg._core.quantile import nearest_rank
from jaxreg.averaging.likelihood import Explained
from jaxreg.averaging.steps.iterate import STILL, WidthOf
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import inverse


#: A kernel is three standard deviations of the noise wide: right edges lose little (the
#: mean is 2 % worse than with the inliers known), wrong ones most.
KERNEL_DEVIATIONS = 3.0
# How far widths may go to settle: annealing halves them at most, so it has not passed
# by more. Of graphs with 465 edges it passes by a hundredth, with ten by up to that.
_NEAR = 2.0


def gaussian_trust(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], width: Float[Array, "2"]
) -> Float[Array, " e"]:
    """G_sigma of the residual of each edge (Eq. 12); widths are (length, angle)."""
    return _gaussian(graph.differences(T_world_i), width)


def _gaussian(differences: tuple[Array, Array], width: Array) -> Array:
    rotation, translation = differences
    sq = translation / width[0] ** 2 + rotation / (2 * width[1] ** 2)
    return jnp.exp(-sq / 2)


def first_width(alone: Explained, scale: Float[Array, ""]) -> Float[Array, "2"]:
    """A width that sees the right edges from poses, and few others.

    Three of the likeliest deviations, and half of the octave between those compared.

    Args:
        alone: how the poses explain the motions where each wrong one is alone.
        scale: the graph's `length_scale`.
    """
    width = KERNEL_DEVIATIONS * 2**0.5 * alone.deviation
    return jnp.stack([width * scale, width])


def width_rule(
    scale: Float[Array, ""],
    begin: Float[Array, "2"],
    settling: Bool[Array, ""],
    held: Bool[Array, ""],
) -> WidthOf:
    """The next width: three deviations of the edges inside the present one.

    While annealing never wider than before, nor narrower than half of it; while
    settling near `begin`, so that it ends as three deviations inside itself; `begin` if
    it is held. `scale` is the `length_scale` of the graph.
    """

    def width_of(graph: PoseGraph, T: Array, width: Array) -> Array:
        target = _three_deviations(graph, T, width, scale)
        least = jnp.where(settling, begin / _NEAR, width / 2)
        most = jnp.where(settling, begin * _NEAR, width)
        return jnp.where(held, begin, jnp.clip(target, least, most))

    return width_of


@eqx.filter_custom_jvp
def followed_width(
    scale: Float[Array, ""],
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    width: Float[Array, "2"],
) -> Float[Array, "2"]:
    """The width that a `width_rule` is given, with derivatives if it has settled.

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
    if change is None:  # information alone: it moves widths by the poses only
        return width, jnp.zeros_like(width)
    by_width = jax.jacfwd(lambda w: _three_deviations(graph, T_world_i, w, scale))
    settled = jnp.abs(target - width) < STILL * width
    slope = jnp.where(settled[:, None], by_width(width), 0)
    change = jnp.where(settled, change, 0)
    return width, inverse(jnp.eye(2, dtype=slope.dtype) - slope) @ change


def _three_deviations(
    graph: PoseGraph, T_world_i: Array, width: Array, scale: Array
) -> Float[Array, "2"]:
    d = graph.dim
    differences = rotation, translation = graph.differences(T_world_i)
    trust = _gaussian(differences, width)
    w = graph.weight * trust
    total = jnp.maximum(jnp.sum(w), jnp.finfo(w.dtype).tiny)
    dof = d * (d - 1) // 2
    v = jnp.stack([jnp.sum(w * translation) / d, jnp.sum(w * rotation) / (2 * dof)])
    v = v / total
    # Noise of many scales would draw the mean to the finest; the median stands.
    inside = (graph.weight > 0) & (trust > 0.5)
    middle = middle_variances(differences, inside, d)
    count = jnp.sum(jnp.where(graph.weight > 0, trust, 0))
    variance = jnp.maximum(variance_inside(v, width), middle)
    variance = spared_variances(graph, variance, count, scale)
    floor = 64 * jnp.finfo(w.dtype).eps * jnp.stack([scale, jnp.ones_like(total)])
    # In this order: the root has no derivative where the edges agree exactly.
    least = (floor / KERNEL_DEVIATIONS) ** 2
    return KERNEL_DEVIATIONS * jnp.sqrt(jnp.maximum(variance, least))


def variance_inside(mean: Array, width: Array) -> Array:
    """Of normal noise whose mean square is `mean` under a kernel of that width.

    Noise of variance s^2 has the mean 1 / (1/s^2 + 1/width^2), which is solved for s^2.
    """
    ratio = jnp.minimum(mean / width**2, 0.9)
    return ratio / (1 - ratio) * width**2


def middle_variances(
    differences: tuple[Float[Array, " e"], Float[Array, " e"]],
    of: Bool[Array, " e"],
    d: int,
) -> Float[Array, "2"]:
    """Of one component of the translation and of the rotation, by the middle edges.

    Args:
        differences: `graph.differences` of the poses.
        of: which edges.
        d: the dimension of space.
    """
    rotation, translation = differences
    both = jnp.stack([translation, rotation])
    middle = jax.vmap(lambda x: nearest_rank(x, of, 0.5))(both)
    usual = [chi2_median(d), 2 * chi2_median(d * (d - 1) // 2)]
    return middle / jnp.asarray(usual, middle.dtype)


def chi2_median(dof: int) -> float:
    """Of the chi-squared law: the middle square of noise of variance one."""
    return exceeded_with(0.5, dof)


def spared_variances(
    graph: PoseGraph,
    variance: Float[Array, "2"],
    count: Float[Array, ""],
    scale: Float[Array, ""],
) -> Float[Array, "2"]:
    """Of one component of the translation and of the rotation, from what poses leave.

    Poses take up noise as in `spare_factor`. Translations may lose all of theirs: of
    few edges to spare each turn can be a little off, so that no translation is. (Not
    the other way round: shifts turn nothing.) Before any edge is seen, noise moves what
    is `scale` away by no less than it turns it; that counts as one more edge to spare.

    Args:
        graph: gives the poses that take up noise.
        variance: mean squares of both parts.
        count: the sum of the trust of the edges.
        scale: the `length_scale` of the graph.
    """
    shift, turn = variance * spare_factor(graph, count)
    spare = jnp.maximum(count - (graph.num_held - 1), 0)
    short = jnp.maximum(turn * scale**2 - shift, 0)
    return jnp.stack([shift + short / (spare + 1), turn])


def spare_factor(graph: PoseGraph, count: Float[Array, ""]) -> Float[Array, ""]:
    """Edges over those that the poses do not use up, at least one: they take up noise.

    `count` is the sum of the trust of the edges.
    """
    spare = jnp.maximum(count - (graph.num_held - 1), 1)
    return jnp.maximum(count / spare, 1)
