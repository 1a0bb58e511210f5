"""Averaging into a frame in which some poses, or some points, are known.

Each part of a graph is averaged on its own, those with fixed frames beside these. Parts
without are brought into the world as rigid bodies; then all is adjusted to all that is
known.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.checks import is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.world.adjustment import Adjustment
from jaxreg.averaging.world.known import Known
from jaxreg.averaging.world.parts import brought
from jaxreg.geometry import lie
from jaxreg.graph.anchored import (
    anchored,
    fixed_as_priors,
    without_priors,
)
from jaxreg.graph.hang import with_hung
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import components


# Poses so many times further from the origin than from each other lose two digits.
_FAR = 100.0


def average_known(
    graph: PoseGraph,
    method: AbstractAverager,
    known: Known,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    """`average` with priors, fixed frames, control points and levels, all checked."""
    if init is not None and known.origin is not None:
        init = init.at[:, :-1, -1].add(-jnp.asarray(known.origin, init.dtype))
    found = _averaged(graph, method, known, init, key, graph.length_scale)
    if known.origin is None:
        return found
    in_world = found.placed & (found.status != Status.DEGENERATE)
    T = moved_back(found.T_world_i, in_world, known.origin)
    # Not by the constructor: JAX without x64 has no arrays of float64.
    return eqx.tree_at(lambda s: s.T_world_i, found, T)


def average_in_world(
    graph: PoseGraph,
    method: AbstractAverager,
    known: Known,
    init: Float[Array, "v D D"],
) -> AveragingSolution:
    """`average` from poses of parts on their own, less the world's origin.

    The unit of length is that of the frames' contents: it stands for a radian.
    """
    unit = jnp.ones(())
    if known.num_fixed:
        label = components(graph.edges, graph.weight, graph.num_poses)
        fixed = fixed_as_priors(known.poses, known.num_fixed)
        held = jax.lax.stop_gradient((init, label, fixed))
        init = brought(*held, None, None, unit).T_world_i
    return _averaged(graph, method, known, init, None, unit)


def _averaged(
    graph: PoseGraph,
    method: AbstractAverager,
    known: Known,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
    unit: Float[Array, ""],
) -> AveragingSolution:
    """The graph alone, by programs that serve whatever is known; then adjusted."""
    rows = known.of_any_number
    whole, start, label = _whole(graph, rows, init)
    found = average_graph(whole, method, start, key)
    found = _adjusted(graph, rows, found, label, unit)
    assert found.prior_weight is not None
    trust = known.without_padding(found.prior_weight)
    return eqx.tree_at(lambda s: s.prior_weight, found, trust)


@kept_program
@control.over_devices
def _adjusted(
    graph: PoseGraph,
    known: Known,
    found: AveragingSolution,
    label: Int[Array, " u"],
    unit: Float[Array, ""],
) -> AveragingSolution:
    """The parts brought into the world, and adjusted to what is known.

    Args:
        graph: the relative motions.
        known: poses, points and levels.
        found: of the graph as a `_whole`.
        label: its parts.
        unit: the length that stands for a radian.
    """
    found, part = _of_own_frames(graph, known, found, label)
    poses, points, levels = known.poses, known.points, known.levels
    held = jax.lax.stop_gradient((found.T_world_i, part, poses, points, levels, unit))
    start = brought(*held)
    T, status = found.T_world_i, found.status
    trust = jnp.zeros(0, T.dtype)
    if known.num_rows:
        told = poses, points, levels
        problem = Adjustment(graph, *told, found.edge_weight, start.held)
        T, ended, trust = problem.solve(start.T_world_i)
        lost = (ended == Status.MAX_STEPS) | (ended == Status.NON_FINITE)
        status = jnp.where(lost & (status == Status.CONVERGED), ended, status)
        # Where half of what is known contradicts the rest, which is right is chance,
        # unless fixed frames decide. Levels tell nothing of places.
        num = known.num_rows - (0 if levels is None else len(levels.frame))
        for kind in (slice(num), slice(num, None)):
            right, count = jnp.sum(trust[kind] > 0.5), jnp.sum(problem.usable[kind])
            undecided = (count > 1) & (2 * right <= count) & ~jnp.any(poses.fixed)
            status = jnp.where(undecided, Status.NO_AGREEMENT, status)
        bent = problem.is_mistaken(T) & ~jnp.any(poses.fixed)
        status = jnp.where(bent, Status.NO_AGREEMENT, status)
    beside = jnp.any(start.held)
    joined = jnp.where(beside, start.held, part == part[0])
    status = jnp.where(jnp.all(joined), status, Status.DISCONNECTED)
    status = jnp.where(beside, status, Status.DEGENERATE)
    label = jnp.where(joined, jnp.argmax(joined).astype(part.dtype), part)
    return eqx.tree_at(
        lambda s: (s.T_world_i, s.prior_weight, s.placed, s.component, s.status),
        found,
        (T, trust, joined, label, status.astype(jnp.int32)),
        is_leaf=lambda x: x is None,
    )


@kept_program
@control.over_devices
def _whole(
    graph: PoseGraph, known: Known, init: Float[Array, "v D D"] | None
) -> tuple[PoseGraph, Float[Array, "u D D"] | None, Int[Array, " u"]]:
    """A graph of one part, the start, and the lowest frame of each frame's own part.

    Parts are hung to frame 0, each to be averaged on its own. Fixed frames are one
    frame, the world, which comes first: the parts that they hold are one part.
    """
    if known.num_fixed:
        poses = known.poses
        if init is not None:
            eye = jnp.eye(graph.dim + 1, dtype=init.dtype)[None]
            fixed = poses.fixed[:, None, None]
            init = jnp.concatenate([eye, jnp.where(fixed, poses.T_world_fixed, init)])
        graph = anchored(graph, without_priors(poses))
    label = components(graph.edges, graph.weight, graph.num_poses)
    frame = jnp.arange(graph.num_poses, dtype=jnp.int32)
    hung = (label == frame) & (label != label[0])
    T_0_i = None if init is None else lie.between(init[0], init)
    return with_hung(graph, hung, T_0_i), init, label


def _of_own_frames(
    graph: PoseGraph, known: Known, found: AveragingSolution, label: Int[Array, " u"]
) -> tuple[AveragingSolution, Int[Array, " v"]]:
    """The poses and the trust of the graph itself, and the parts of its frames."""
    T_world_i, part, num = found.T_world_i, label, graph.num_poses
    if known.num_fixed:
        poses = known.poses
        label = jnp.where(poses.fixed, 0, label[1:])
        frame = jnp.arange(num, dtype=jnp.int32)
        part = jax.ops.segment_min(frame, label, num + 1)[label]
        fixed = poses.fixed[:, None, None]
        T_world_i = jnp.where(fixed, poses.T_world_fixed, T_world_i[1:])
    at = lambda s: (s.T_world_i, s.edge_weight)  # noqa: E731
    trust = found.edge_weight[: graph.num_edges]
    return eqx.tree_at(at, found, (T_world_i, trust)), part


def moved_back(
    T_world_i: Float[Array, "v D D"], placed: Bool[Array, " v"], origin: np.ndarray
) -> Float[Array, "v D D"] | np.ndarray:
    """In the frame of what is known; far from its origin in float64 on the host."""
    T = T_world_i
    if is_concrete(T) and T.dtype == jnp.float32 and np.any(placed):
        wide = np.asarray(T, np.float64)
        near = wide[np.asarray(placed), :-1, -1]
        if np.sum(origin**2) > _FAR**2 * np.mean(np.sum(near**2, axis=-1)):
            wide[:, :-1, -1] += np.where(np.asarray(placed)[:, None], origin, 0)
            return wide
    shift = jnp.where(jnp.asarray(placed)[:, None], jnp.asarray(origin, T.dtype), 0)
    return T.at[:, :-1, -1].add(shift)
