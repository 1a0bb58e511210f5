"""One graph: reduced to what frame 0 reaches, averaged, and put at its place."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.likelihood import Likelihood
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.averaging.unit import in_range
from jaxreg.geometry import lie
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


@control.over_devices
def average_graph(
    graph: PoseGraph,
    method: AbstractAverager,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
    present: Bool[Array, " v"] | None = None,
) -> AveragingSolution:
    """`average` of checked arguments; frames that are not `present` are padding."""
    reduced, method, T_start, gauge = _prepared(graph, method, init)
    return _concluded(reduced, method.solve(reduced, T_start, key), gauge, present)


@control.over_devices
def follow_graph(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], present: Bool[Array, " v"]
) -> AveragingSolution:
    """Poses that `PoseGraphLM` has found, with the derivatives that they have there."""
    reduced, method, T_start, gauge = _prepared(graph, PoseGraphLM(), T_world_i)
    assert isinstance(method, PoseGraphLM)
    assert T_start is not None
    found = jnp.asarray(True), jnp.zeros((), jnp.int32), None
    found = method.solution_at(reduced, T_start, *found)
    return _concluded(reduced, found, gauge, present)


def _concluded(
    reduced: PoseGraph,
    found: AveragingSolution,
    gauge: "_Gauge",
    present: Bool[Array, " v"] | None,
) -> AveragingSolution:
    """In the frame that was given; says so if nothing agrees."""
    evidence = found.log_evidence
    # Few answers are doubted: what judges them is compiled for one that is.
    if not is_concrete(evidence) or float(evidence) <= 0:
        found = _doubted(reduced, found)
    return _placed(found, gauge, present)


@kept_program
def _doubted(reduced: PoseGraph, found: AveragingSolution) -> AveragingSolution:
    """NO_AGREEMENT where that is so."""
    none = Likelihood.of(reduced).nothing_agrees(found.log_evidence)
    status = jnp.where(none, Status.NO_AGREEMENT, found.status)
    return eqx.tree_at(lambda s: s.status, found, status.astype(jnp.int32))


class _Gauge(NamedTuple):
    T_world_0: Array
    unit: Array
    component: Array
    finite: Array


@kept_program
def _prepared(
    graph: PoseGraph, method: AbstractAverager, init: Float[Array, "v D D"] | None
) -> tuple[PoseGraph, AbstractAverager, Float[Array, "v D D"] | None, _Gauge]:
    """What a method needs: a graph joined to frame 0, which is at the identity."""
    dtype, d = graph.T_i_j.dtype, graph.dim
    method = cast_floats(method, dtype)
    reduced, component, finite = _reduce(graph)
    reduced, unit = in_range(reduced)
    T_start, T_world_0 = None, jnp.eye(d + 1, dtype=dtype)
    if init is not None:
        sound = jnp.all(jnp.isfinite(init), axis=(1, 2))
        finite = finite & jnp.all(sound)
        init = jnp.where(sound[:, None, None], init, T_world_0[None])
        T_world_0 = init[0]
        T_0_i = lie.between(T_world_0, init)
        T_start = lie.compose(lie.rotation(T_0_i), lie.translation(T_0_i) / unit)
    return reduced, method, T_start, _Gauge(T_world_0, unit, component, finite)


@kept_program
def _placed(
    out: AveragingSolution, gauge: _Gauge, present: Bool[Array, " v"] | None
) -> AveragingSolution:
    out = out.in_unit(gauge.unit)
    T_0_i, placed = out.T_world_i, gauge.component == gauge.component[0]
    eye = jnp.eye(T_0_i.shape[-1], dtype=T_0_i.dtype)[None]
    sound = jnp.all(jnp.isfinite(T_0_i), axis=(1, 2))
    T_world_i = jnp.where(sound[:, None, None], gauge.T_world_0 @ T_0_i, eye)
    T_world_i = jnp.where(placed[:, None, None], T_world_i, eye)
    reached = jnp.all(placed if present is None else placed | ~present)
    status = jnp.where(reached, out.status, Status.DISCONNECTED)
    # Squares of one length may overflow beside those of the others.
    told = jnp.isfinite(out.edge_weight)
    edge_weight = jnp.where(told, out.edge_weight, 0)
    finite = gauge.finite & jnp.all(sound) & jnp.all(told)
    status = jnp.where(finite, status, Status.NON_FINITE).astype(jnp.int32)
    return eqx.tree_at(
        lambda s: (s.T_world_i, s.edge_weight, s.placed, s.component, s.status),
        out,
        (T_world_i, edge_weight, placed, gauge.component, status),
    )


def _reduce(graph: PoseGraph) -> tuple[PoseGraph, Array, Array]:
    """The graph without edges that are masked, not finite, or not joined to frame 0.

    Also the component of each frame, and whether all numbers were finite.
    """
    finite = jnp.all(jnp.isfinite(graph.T_i_j), axis=(1, 2)) & (
        jnp.isfinite(graph.weight) & (graph.weight >= 0)
    )
    used = graph.mask & finite & (graph.edges[:, 0] != graph.edges[:, 1])
    weight = jnp.where(used, graph.weight, 0)
    component = trees.components(graph.edges, weight, graph.num_poses)
    placed = component == component[0]
    used = used & placed[graph.edges[:, 0]]
    eye = jnp.eye(graph.dim + 1, dtype=graph.T_i_j.dtype)[None]
    info = graph.information
    reduced = PoseGraph(
        edges=jnp.where(used[:, None], graph.edges, 0),
        T_i_j=jnp.where(used[:, None, None], graph.T_i_j, eye),
        weight=jnp.where(used, weight, 0),
        mask=used,
        information=None if info is None else jnp.where(used[:, None, None], info, 0),
        num_poses=graph.num_poses,
    )
    return reduced, component, jnp.all(finite | ~graph.mask)
