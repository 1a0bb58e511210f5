"""The loop of motion averaging: residual motions, one Laplacian solve, left update."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.averaging.base import length_scale
from jaxreg.averaging.implicit import differentiable
from jaxreg.averaging.laplacian import solve_flow
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


#: Kernel widths `(2,)` at given poses: translation (length), rotation (radians).
WidthOf = Callable[[PoseGraph, Array], Array]
#: Trust of each edge `(e,)` at given poses and widths.
TrustOf = Callable[[PoseGraph, Array, Array], Array]
#: Weights `(e,)` of the Laplacian from prior weight and trust.
RowsOf = Callable[[PoseGraph, Array], Array]


class Iterated(NamedTuple):
    """Where the loop stopped."""

    T_world_i: Float[Array, "v D D"]
    trust: Float[Array, " e"]
    width: Float[Array, "2"]
    converged: Bool[Array, ""]
    num_steps: Int[Array, ""]


class _State(NamedTuple):
    T: Array
    width: Array
    change: Array
    step: Array


def nearby_rotation(T: Float[Array, "*b D D"]) -> Float[Array, "*b D D"]:
    """One Newton step back onto SE(d), exact to second order in the departure."""
    R = lie.rotation(T)
    eye = jnp.eye(R.shape[-1], dtype=R.dtype)
    return lie.compose(
        R @ (1.5 * eye - 0.5 * jnp.swapaxes(R, -1, -2) @ R), lie.translation(T)
    )


def left_update(
    tangent: Float[Array, "v k"], T_world_i: Float[Array, "v D D"]
) -> Float[Array, "v D D"]:
    """exp(dm_i) T_world_i: Eq. 21 with the update on the side that Eq. 14 asks for.

    As printed, on the right, the iteration diverges.
    """
    return nearby_rotation(lie.exp(tangent) @ T_world_i)


def iterate(
    graph: PoseGraph,
    T_start: Float[Array, "v D D"],
    width_of: WidthOf,
    trust_of: TrustOf,
    rows_of: RowsOf,
    *,
    max_steps: int,
    tolerance: Array | float,
) -> Iterated:
    """Alternates weights and weighted averaging until the poses stand still.

    Stops when no rotation moves by more than `tolerance` radians and no position by
    more than `tolerance` of the size of the scene, or after `max_steps`.

    Gradients: implicit at the fixed point with respect to `graph.T_i_j` and
    `graph.weight`; the kernel width and the start are cut.
    """
    fixed = jax.lax.stop_gradient(graph)
    scale = length_scale(graph)
    eps = 32 * jnp.finfo(T_start.dtype).eps
    limit = jnp.maximum(jax.lax.stop_gradient(tolerance), eps)

    def unfinished(s: _State) -> Array:
        return (s.change > limit) & (s.step < max_steps)

    def step(s: _State) -> _State:
        width = width_of(fixed, s.T)
        weight = rows_of(fixed, trust_of(fixed, s.T, width))
        flow = lie.log(fixed.residual_motions(s.T))
        tangent = solve_flow(fixed.edges, weight, flow, fixed.num_poses)
        T = left_update(tangent, s.T)
        return _State(T, width, pose_change(s.T, T, scale), s.step + 1)

    T_start = jax.lax.stop_gradient(T_start)
    start = _State(
        T=T_start,
        width=jax.lax.stop_gradient(width_of(fixed, T_start)),
        change=jnp.asarray(jnp.inf, T_start.dtype),
        step=jnp.asarray(0, jnp.int32),
    )
    end = jax.lax.while_loop(unfinished, step, start)
    width = jax.lax.stop_gradient(end.width)

    def stationarity_weight(g: PoseGraph, T: Array) -> Array:
        return rows_of(g, trust_of(g, T, width))

    T = differentiable(graph, end.T, stationarity_weight)
    trust = trust_of(graph, T, width)
    return Iterated(T, trust, width, end.change <= limit, end.step)


def pose_change(T_old: Array, T_new: Array, scale: Array) -> Array:
    """The largest rotation (radians) or shift (over the size of the scene)."""
    t_old, t_new = lie.translation(T_old), lie.translation(T_new)
    spread = jnp.sqrt(
        jnp.mean(jnp.sum((t_new - jnp.mean(t_new, axis=0)) ** 2, axis=-1))
    )
    turn = jnp.sqrt(jnp.sum((lie.rotation(T_new) - lie.rotation(T_old)) ** 2, (-2, -1)))
    shift = jnp.sqrt(jnp.sum((t_new - t_old) ** 2, axis=-1)) / (scale + spread)
    return jnp.maximum(jnp.max(turn), jnp.max(shift))
