"""Graphs whose lengths or weights have squares that a float cannot hold."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.quantile import nearest_rank
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


def in_range(graph: PoseGraph) -> tuple[PoseGraph, Float[Array, ""]]:
    """The graph with middle length and greatest weight where squares of squares exist.

    Most graphs are as they were. The factors are powers of two, which cost no digits.

    Returns:
        The graph, and the length that is its unit.

    Gradients: through the graph; the factors are held.
    """
    held = jax.lax.stop_gradient(graph)
    t = lie.translation(graph.T_i_j)
    length = jnp.max(jnp.abs(lie.translation(held.T_i_j)), axis=-1)
    unit = _factor(nearest_rank(length, held.mask & (length > 0), 0.5))
    greatest = _factor(jnp.max(held.weight, initial=0))
    present = graph.weight > 0
    # A weight that vanishes beside the greatest still joins its frames.
    least = jnp.finfo(t.dtype).tiny ** 0.5
    weight = graph.weight / greatest
    weight = jnp.where(present & (greatest != 1), jnp.maximum(weight, least), weight)
    info = graph.information
    if info is not None:
        axes = jnp.where(jnp.arange(info.shape[-1]) < graph.dim, unit, 1)
        info = info * axes * axes[:, None]
    T_i_j = lie.compose(lie.rotation(graph.T_i_j), t / unit)
    changed = dataclasses.replace(graph, T_i_j=T_i_j, weight=weight, information=info)
    return changed, unit


def _factor(size: Float[Array, ""]) -> Float[Array, ""]:
    """One where `size` is 0 or has a sound fourth power, else a power of two by it."""
    info = jnp.finfo(size.dtype)
    sound = (size >= info.tiny**0.25) & (size <= info.max**0.25)
    power = jnp.floor(jnp.log2(jnp.where(size > 0, size, 1))).astype(jnp.int32)
    one = jnp.ones_like(size)
    return jnp.where(sound | (size <= 0), one, jnp.ldexp(one, power))
