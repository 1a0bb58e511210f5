"""`average`: one pose per frame from relative motions."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import as_float_array
from jaxreg._core.compile import compiled
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.correntropy import Correntropy
from jaxreg.geometry import lie
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


def average(
    graph: PoseGraph,
    method: AbstractAverager | None = None,
    init: object = None,
    key: Key | None = None,
) -> AveragingSolution:
    """Finds poses that agree with relative motions: `T_i_j = inv(T_world_i) T_world_j`.

    Frame 0 is fixed at `init[0]`, or at the identity. Works under `jit`, `vmap` (over
    graphs with a leading axis on every array) and `grad`. The answer has the dtype of
    the graph and does not depend on the unit of length.

        >>> import jaxreg as jr
        >>> east = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> far = [[1, 0, 2.3], [0, 1, 0], [0, 0, 1]]
        >>> edges = [(0, 1), (1, 2), (0, 2)]
        >>> graph = jr.PoseGraph.from_edges(edges, [east, east, far])
        >>> sol = jr.average(graph, jr.MotionAveraging())
        >>> sol.T_world_i[:, 0, 2].round(2)
        Array([0. , 1.1, 2.2], dtype=float32)

    Args:
        graph: the relative motions, see `PoseGraph.from_edges`.
        method: how to average; None for `Correntropy()`.
        init: `(v, d+1, d+1)` poses to start from, or None to start from the motions
            alone, as the method's docstring says.
        key: for methods that draw random numbers; the others ignore it.

    Returns:
        An `AveragingSolution`. Status DISCONNECTED: some frames are not joined to frame
        0 by edges of positive weight, see `placed`. NON_FINITE: edges or poses with NaN
        or inf were met; such edges are ignored, such poses returned as the identity.
        MAX_STEPS: the steps ran out.

    Raises:
        TypeError: if `graph` is no PoseGraph or `method` no averaging method.
        ValueError: if `init` has another shape than the poses.

    Gradients: see the method. `T_world_i` always follows `init[0]`.
    """
    if not isinstance(graph, PoseGraph):
        raise TypeError(
            "graph: wanted a PoseGraph (see PoseGraph.from_edges), "
            f"found {type(graph).__name__}."
        )
    method = Correntropy() if method is None else method
    if not isinstance(method, AbstractAverager):
        raise TypeError(
            f"method: wanted an averaging method, found {type(method).__name__}."
        )
    if init is not None:
        D = graph.dim + 1
        init = as_float_array(init, "init").astype(graph.T_i_j.dtype)
        if init.shape != (graph.num_poses, D, D):
            raise ValueError(
                f"init: wanted shape {(graph.num_poses, D, D)}, found {init.shape}."
            )
    reduced, method, T_start, gauge = _prepared(graph, method, init)
    return _placed(method.solve(reduced, T_start, key), gauge)


class _Gauge(NamedTuple):
    T_world_0: Array
    component: Array
    finite: Array


@compiled
def _prepared(
    graph: PoseGraph, method: AbstractAverager, init: Float[Array, "v D D"] | None
) -> tuple[PoseGraph, AbstractAverager, Float[Array, "v D D"] | None, _Gauge]:
    """What a method needs: a graph joined to frame 0, which is at the identity."""
    dtype, d = graph.T_i_j.dtype, graph.dim
    method = cast_floats(method, dtype)
    reduced, component, finite = _reduce(graph)
    T_start, T_world_0 = None, jnp.eye(d + 1, dtype=dtype)
    if init is not None:
        sound = jnp.all(jnp.isfinite(init), axis=(1, 2))
        finite = finite & jnp.all(sound)
        init = jnp.where(sound[:, None, None], init, jnp.eye(d + 1, dtype=dtype))
        T_world_0 = init[0]
        T_start = lie.inverse(T_world_0) @ init
    return reduced, method, T_start, _Gauge(T_world_0, component, finite)


@compiled
def _placed(out: AveragingSolution, gauge: _Gauge) -> AveragingSolution:
    T_0_i, placed = out.T_world_i, gauge.component == gauge.component[0]
    eye = jnp.eye(T_0_i.shape[-1], dtype=T_0_i.dtype)
    sound = jnp.all(jnp.isfinite(T_0_i), axis=(1, 2))
    T_world_i = jnp.where(sound[:, None, None], gauge.T_world_0 @ T_0_i, eye)
    T_world_i = jnp.where(placed[:, None, None], T_world_i, eye)
    status = jnp.where(jnp.all(placed), out.status, Status.DISCONNECTED)
    finite = gauge.finite & jnp.all(sound)
    status = jnp.where(finite, status, Status.NON_FINITE).astype(jnp.int32)
    return eqx.tree_at(
        lambda s: (s.T_world_i, s.placed, s.component, s.status),
        out,
        (T_world_i, placed, gauge.component, status),
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
    eye = jnp.eye(graph.dim + 1, dtype=graph.T_i_j.dtype)
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
