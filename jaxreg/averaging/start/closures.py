"""Closures of a sequence that its drift allows and others next to them confirm."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg.averaging.start.cycles import NEUTRAL
from jaxreg.averaging.start.drift import drifted
from jaxreg.geometry import lie
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import along_frames
from jaxreg.linear.small import product


# Closures next to each other have ends less than so many frames apart, and are less
# than so many apart in their order: a place passed again is seen for some frames.
_NEAR = 8


def without_doubtful_closures(graph: PoseGraph) -> PoseGraph:
    """The graph without closures that are likely false; little of those it hangs on.

    Closures that are off by more than the drift of the sequence explains are false. And
    a sequence passes a place again for some frames and closes several loops there,
    which agree with each other along the frames between their ends. False closures
    stand alone as a rule. Where less than half of those that drift allows are
    confirmed, or of the frames measured from the one before, as in graphs that are no
    sequences, none is left out for standing alone. For starts: any weight of false
    closures bends a long sequence, which hardly resists, so only those stay that join
    components.
    """
    closure = (graph.weight > 0) & ~graph.successive
    supported = confirmed(graph, closure)
    far = drifted(graph, closure)
    usual = jnp.sum(supported & ~far) >= jnp.sum(closure & ~far) / 2
    steps = jnp.sum((graph.weight > 0) & graph.successive)
    usual = usual & (steps >= (graph.num_poses - 1) / 2)
    doubted = closure & usual & ~supported | far
    little = jnp.finfo(graph.weight.dtype).eps ** 0.5
    weight = jnp.where(doubted, little * graph.weight, graph.weight)
    tree = trees.maximum_spanning_tree(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    )
    weight = jnp.where(doubted & ~tree.in_tree, 0, weight)
    return eqx.tree_at(lambda g: g.weight, graph, weight)


def confirmed(graph: PoseGraph, closure: Bool[Array, " e"]) -> Bool[Array, " e"]:
    """Closures that agree with another whose ends are near theirs."""
    turned = graph.edges[:, 0] > graph.edges[:, 1]
    T_low_high = jnp.where(turned[:, None, None], lie.inverse(graph.T_i_j), graph.T_i_j)
    low, high = jnp.min(graph.edges, axis=1), jnp.max(graph.edges, axis=1)
    T_world_i, scale = along_frames(graph), graph.length_scale
    order = jnp.arange(graph.num_edges, dtype=jnp.int32)
    cell = jnp.where(closure, low // _NEAR, graph.num_poses)
    order = jax.lax.sort((cell, high, order), num_keys=2)[2]
    cell, low, high, T_low_high = (x[order] for x in (cell, low, high, T_low_high))
    # The motion between the chained places of the ends that the closure asks for.
    gap = product(T_world_i[low], product(T_low_high, lie.inverse(T_world_i)[high]))

    def compared(step: Array, supported: Array) -> Array:
        k, m = jnp.roll(low, -step), jnp.roll(high, -step)
        expected = lie.between(T_world_i[k], product(gap, T_world_i[m]))
        error = lie.between(jnp.roll(T_low_high, -step, axis=0), expected)
        near = (jnp.roll(cell, -step) == cell) & (jnp.abs(m - high) < _NEAR)
        agree = near & closure[order] & (_size(error, scale) < NEUTRAL[0] ** 2)
        return supported | agree | jnp.roll(agree, step)

    none = jnp.zeros((graph.num_edges,), bool)
    supported = control.fori_loop(1, _NEAR, compared, none)
    return none.at[order].set(supported)


def _size(T: Float[Array, "e D D"], scale: Float[Array, ""]) -> Float[Array, " e"]:
    """Squared angle (chordal) plus squared length over `scale`."""
    turn = lie.rotation(T) - jnp.eye(T.shape[-1] - 1, dtype=T.dtype)
    shift = lie.translation(T)
    return jnp.sum(turn**2, axis=(1, 2)) / 2 + jnp.sum(shift**2, axis=1) / scale**2
