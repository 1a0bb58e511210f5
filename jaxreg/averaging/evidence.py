"""How well poses explain motions, without a noise level: scores of hypotheses."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.base import (
    length_scale,
    nearest_rank,
    num_held,
    weighted_mean,
)
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, product


#: Errors, in radians and length scales, from coarse to fine.
SCALES = tuple(0.5 / 2**k for k in range(8))
# The scales of `coherence`, the nearest measured neighbours that a frame must agree
# with, and what they count in dense graphs. Chosen on all 33 scenes of
# learning2sync_relative_poses and on synthetic graphs: none was held out.
_COARSE, _NEIGHBOURS, _NEAR = (0.4, 0.2, 0.1, 0.05, 0.025), 4, 3.0
# The log likelihood ratio of agreement; deviations that are put down to chance.
_AGREEMENT, _CHANCE = 2.0, 2.0


def squared_errors(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], scale: Float[Array, ""]
) -> Float[Array, " e"]:
    """Squared angle (chordal) plus squared length over `scale` of each edge."""
    rotation, translation = graph.differences(T_world_i)
    return rotation / 2 + translation / scale**2


def prior_odds(graph: PoseGraph) -> Float[Array, " e"]:
    """The logarithm of each prior weight over the middle one; 0 for absent edges.

    A weight says how much likelier than usual an edge is right.
    """
    present = graph.weight > 0
    usual = nearest_rank(graph.weight, present, 0.5)
    return jnp.log(jnp.where(present, graph.weight / jnp.where(usual > 0, usual, 1), 1))


def votes(graph: PoseGraph) -> Float[Array, " e"]:
    """What agreement with each edge counts: its log odds, in those of a usual edge.

    By Bayes' rule agreement is worth the logarithm of the likelihood ratio plus that of
    the prior odds: weights count by their logarithm. 0 for absent edges.
    """
    count = jnp.maximum(1 + prior_odds(graph) / _AGREEMENT, 0.1)
    return jnp.where(graph.weight > 0, count, 0)


def agreement(graph: PoseGraph, T_world_i: Array, scale: Array) -> Array:
    """Edges that agree, by `votes`, summed over the ladder of scales."""
    return jnp.sum(_agreed(graph, T_world_i, scale))


def _agreed(graph: PoseGraph, T_world_i: Array, scale: Array) -> Float[Array, " s"]:
    sq, count = squared_errors(graph, T_world_i, scale), votes(graph)
    width = jnp.asarray(SCALES, sq.dtype)[:, None]
    return jnp.sum(count * jnp.exp(-sq / (2 * width**2)), axis=1)


def redundancies(graph: PoseGraph, T_world_i: Array) -> Float[Array, " s"]:
    """Edges that agree beyond those that any tree agrees with, at each of the scales.

    A chain of motions agrees with its own edges, however far it drifts.
    """
    count = votes(graph)
    free = _free(graph, count)
    return jnp.maximum(_agreed(graph, T_world_i, length_scale(graph)) - free, 0)


def _free(graph: PoseGraph, count: Float[Array, " e"]) -> Float[Array, ""]:
    """What the edges of a tree count."""
    usual = jnp.sum(count) / jnp.maximum(jnp.sum(count > 0), 1)
    return (num_held(graph) - 1) * usual


def redundancy(graph: PoseGraph, T_world_i: Array) -> Array:
    """The sum of `redundancies`."""
    return jnp.sum(redundancies(graph, T_world_i))


def agrees(sq: Array) -> Array:
    """How far errors of these squares are agreement: 1 to 0, over coarse scales."""
    parts = [1 / (1 + (sq / w**2) ** 2) for w in _COARSE]
    return jnp.mean(jnp.stack(parts), axis=0)


def coherence(graph: PoseGraph, T_world_i: Array, scale: Array) -> Array:
    """Do frames agree with those that the poses put next to them?

    Registration fails for views far apart and seldom for near ones; its failures agree
    with each other where an object looks alike from several sides, often in greater
    numbers than the right motions. Poses that follow them put frames beside others
    whose motions say otherwise. So: the share of all edges that agree, plus that of the
    edges to the nearest measured neighbours of each frame, which counts the more the
    fewer of its neighbours those are, and only so far as it is more than chance would
    give to as many edges: a search finds what profits by chance. Dense over frames.

    Where edges are few, nearly all neighbours are among the nearest and say nothing
    else, and many edges are those of a tree, which agrees with itself. There: the share
    of the edges beyond a tree that agree, the mean of `redundancies` over the scales.
    """
    count = votes(graph)
    if graph.num_edges <= _NEIGHBOURS * graph.num_poses:
        spare = jnp.sum(count) - _free(graph, count)
        return redundancy(graph, T_world_i) / jnp.maximum(len(SCALES) * spare, 1)
    sq = squared_errors(graph, T_world_i, scale)
    agreed = agrees(sq)
    i, j, num = graph.edges[:, 0], graph.edges[:, 1], graph.num_poses
    gap = product(lie.inverse(T_world_i)[i], T_world_i[j])
    near = graph.dim - jnp.trace(lie.rotation(gap), axis1=-2, axis2=-1)
    near = near + jnp.sum(lie.translation(gap) ** 2, axis=-1) / scale**2
    near = jnp.where(graph.weight > 0, near, jnp.inf)
    distance = jnp.full((num, num), jnp.inf, sq.dtype)
    distance = distance.at[i, j].min(near).at[j, i].min(near)
    nearest, index = jax.lax.top_k(-distance, min(_NEIGHBOURS, num))
    frames = jnp.arange(num)[:, None]

    def table(x: Array) -> Array:
        dense = jnp.zeros((num, num), sq.dtype).at[i, j].max(x).at[j, i].max(x)
        return jnp.where(jnp.isfinite(nearest), dense[frames, index], 0)

    weight, mean = table(count), weighted_mean(agreed, count)
    own = weighted_mean(table(count * agreed), jnp.ones_like(weight))
    own = own / jnp.maximum(jnp.mean(weight), jnp.finfo(sq.dtype).tiny)
    held = num_held(graph)
    chance = jnp.sqrt(mean * (1 - mean) / (0.5 * _NEIGHBOURS * held))
    own = jnp.maximum(own - _CHANCE * chance, mean)
    degree = 2 * jnp.sum((graph.weight > 0).astype(sq.dtype)) / held
    select = jnp.maximum(1 - 2 * _NEIGHBOURS / jnp.maximum(degree, 1), 0) ** 3
    return _NEAR * select * own + mean
