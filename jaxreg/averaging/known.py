"""Averaging into a frame in which some poses, or some points, are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg._core.checks import is_concrete
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.control_points import ControlPoints, fitted
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.known_checks import Known
from jaxreg.graph.anchored import KnownPoses, anchored
from jaxreg.graph.pose_graph import PoseGraph


# Poses so many times further from the origin than from each other lose two digits.
_FAR = 100.0


def average_known(
    graph: PoseGraph,
    method: AbstractAverager,
    known: Known,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    """`average` with priors, fixed frames and control points, all checked."""
    if init is not None and known.origin is not None:
        init = init.at[:, :-1, -1].add(-jnp.asarray(known.origin, init.dtype))
    found = _averaged(graph, method, known.poses, known.points, init, key)
    return found if known.origin is None else _moved_back(found, known.origin)


@eqx.filter_jit
@control.over_devices
def _averaged(
    graph: PoseGraph,
    method: AbstractAverager,
    poses: KnownPoses | None,
    points: ControlPoints | None,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    if poses is None:
        found = average_graph(graph, method, init, key)
    else:
        found = _in_world(graph, method, poses, init, key)
    return found if points is None else fitted(graph, poses, points, found)


def _in_world(
    graph: PoseGraph,
    method: AbstractAverager,
    poses: KnownPoses,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    """Of the anchored graph, told of the frames and edges of the graph itself."""
    fixed = poses.fixed[:, None, None]
    if init is not None:
        eye = jnp.eye(graph.dim + 1, dtype=init.dtype)[None]
        init = jnp.concatenate([eye, jnp.where(fixed, poses.T_world_fixed, init)])
    present = jnp.append(True, ~poses.fixed)
    found = average_graph(anchored(graph, poses), method, init, key, present)
    joined = found.placed[1:] | poses.fixed
    frame = jnp.arange(graph.num_poses, dtype=jnp.int32)
    label = jnp.where(joined, 0, found.component[1:])
    first = jax.ops.segment_min(frame, label, graph.num_poses + 1)
    return eqx.tree_at(
        lambda s: (s.T_world_i, s.edge_weight, s.prior_weight, s.placed, s.component),
        found,
        (
            jnp.where(fixed, poses.T_world_fixed, found.T_world_i[1:]),
            found.edge_weight[: graph.num_edges],
            found.edge_weight[graph.num_edges :],
            joined,
            first[label],
        ),
        is_leaf=lambda x: x is None,
    )


def _moved_back(found: AveragingSolution, origin: np.ndarray) -> AveragingSolution:
    """In the frame of what is known; far from its origin in float64 on the host."""
    T, placed = found.T_world_i, found.placed
    if is_concrete(T) and T.dtype == jnp.float32 and np.any(placed):
        wide = np.asarray(T, np.float64)
        near = wide[np.asarray(placed), :-1, -1]
        if np.sum(origin**2) > _FAR**2 * np.mean(np.sum(near**2, axis=-1)):
            wide[:, :-1, -1] += np.where(np.asarray(placed)[:, None], origin, 0)
            # Not by the constructor: JAX without x64 has no such arrays.
            return eqx.tree_at(lambda s: s.T_world_i, found, wide)
    shift = jnp.where(placed[:, None], jnp.asarray(origin, T.dtype), 0)
    return eqx.tree_at(lambda s: s.T_world_i, found, T.at[:, :-1, -1].add(shift))
