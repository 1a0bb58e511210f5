"""Many graphs of unequal sizes: padded to few sizes, some side by side."""

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.checks import as_float_array, check_rigid, is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key, Progress
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.gauge import average_graph
from jaxreg.batching.devices import Devices, map_rows, spread_rows
from jaxreg.batching.padding import lengthened, rounded_up, stacked
from jaxreg.batching.progress import tell
from jaxreg.batching.side_by_side import side_by_side
from jaxreg.graph.pose_graph import PoseGraph, check_graph, check_poses
from jaxreg.linear.laplacian import DENSE_LIMIT


# Graphs, which frames they have, their starts and keys; a leading axis on all arrays.
_Lanes = tuple[PoseGraph, Array | None, Array | None, Array | None]

# The least number of poses that graphs are padded to, and half that of edges: a power
# of two; smaller programs take as long to compile.
_LEAST = 8
# Graphs in one call of a compiled program, at most, unless more are side by side:
# progress is told after each, and a call costs a small share of so many graphs.
_PIECE = 64


def check_init(
    init: object, graph: PoseGraph, name: str
) -> Float[Array, "v D D"] | None:
    """Requires a pose for each frame, or None."""
    if init is None:
        return None
    found = check_poses(init, name, graph)
    check_rigid(found, name)
    return found


def average_one(
    graph: PoseGraph,
    method: AbstractAverager,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    """`average_graph`; small graphs of similar sizes share its programs."""
    if graph.num_poses > DENSE_LIMIT:
        return average_graph(graph, method, init, key)
    return average_rounded(graph, method, init, key)


def average_rounded(
    graph: PoseGraph,
    method: AbstractAverager,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> AveragingSolution:
    """`average_graph`, by a program that graphs of similar sizes share."""
    arrays = jax.tree.leaves((graph, init, key))
    own = (graph.num_poses, graph.num_edges)
    # Small ones compile for as long as they run in tens of calls; of large ones each
    # row that is added costs.
    small = graph.num_poses <= DENSE_LIMIT
    an_octave = 1 if small else 2
    num_poses = rounded_up(graph.num_poses, _LEAST, an_octave)
    least = 2 * (num_poses if small else _LEAST)
    num_edges = rounded_up(graph.num_edges, least, an_octave)
    if (num_poses, num_edges) == own or not all(map(_is_held, arrays)):
        return average_graph(graph, method, init, key)
    padded = dataclasses.replace(graph, num_poses=num_poses)
    padded = jax.tree.map(lambda x: lengthened(x, num_edges), padded)
    present = jax.device_put(np.arange(num_poses) < graph.num_poses)
    if init is not None:
        eye = np.eye(init.shape[-1], dtype=init.dtype)
        more = np.broadcast_to(eye, (num_poses - len(init), *eye.shape))
        init = jax.device_put(np.concatenate([init, more]))
    found = average_graph(padded, method, init, key, present)
    return _cut(jax.tree.map(lambda x: np.asarray(x)[None], found), 0, graph)


def _is_held(x: Array) -> bool:
    """Whether an array is here, and no device was chosen for it."""
    return is_concrete(x) and not x.committed


def average_list(
    graphs: Sequence[object],
    method: AbstractAverager,
    init: object,
    key: Key | None,
    batch_size: int | None,
    progress: Progress | None,
    devices: Devices | None,
) -> list[AveragingSolution]:
    """`average` of each; graphs of similar sizes share a program."""
    checked = _check_alike(graphs)
    inits = _check_inits(init, checked)
    keys = None if key is None else jax.random.split(key, len(checked))
    out: dict[int, AveragingSolution] = {}
    stage = "averaging graphs"
    tell(progress, stage, 0, len(checked), checked, inits, keys)
    for rows, padded_to in _pieces(checked, batch_size):
        some = [checked[k] for k in rows]
        starts = None if inits is None else [inits[k] for k in rows]
        lanes = _padded(some, starts, *padded_to)
        own_keys = None if keys is None else keys[rows]
        lanes = spread_rows(devices, (*lanes, own_keys))
        at_once = side_by_side(batch_size, padded_to[1], lanes)
        found = _average_lanes(method, lanes, at_once, devices)
        if is_concrete(found.status):
            found = jax.tree.map(np.asarray, found)  # slices compile nothing
        out |= {k: _cut(found, lane, checked[k]) for lane, k in enumerate(rows)}
        tell(progress, stage, len(out), len(checked), found)
    return [out[k] for k in range(len(checked))]


def average_batch(
    graphs: PoseGraph,
    method: AbstractAverager,
    init: object,
    key: Key | None,
    batch_size: int | None,
    devices: Devices | None,
) -> AveragingSolution:
    """Of graphs of one size, with a leading axis on every array."""
    num, frames, D = len(graphs.T_i_j), graphs.num_poses, graphs.dim + 1
    starts = None
    if init is not None:
        starts = as_float_array(init, "init").astype(graphs.T_i_j.dtype)
        if starts.shape != (num, frames, D, D):
            raise ValueError(
                f"init: wanted shape {(num, frames, D, D)}, found {starts.shape}."
            )
        check_rigid(starts, "init")
    keys = None if key is None else jax.random.split(key, num)
    lanes = spread_rows(devices, (graphs, None, starts, keys))
    at_once = side_by_side(batch_size, graphs.edges.shape[1], lanes)
    return _average_lanes(method, lanes, at_once, devices)


def _pieces(
    graphs: list[PoseGraph], batch_size: int | None
) -> Iterator[tuple[np.ndarray, tuple[int, int]]]:
    """Graphs that are averaged in one call, and the poses and edges they get.

    Of one size all pieces have as many, the last one some of the one before.
    """
    sizes = np.array([rounded_up(g.num_poses, _LEAST) for g in graphs])
    for num_poses in np.unique(sizes):
        rows = np.flatnonzero(sizes == num_poses)
        num_edges = rounded_up(max(graphs[k].num_edges for k in rows), 2 * _LEAST)
        piece = -(-len(rows) // -(-len(rows) // max(_PIECE, batch_size or 1)))
        for start in range(0, len(rows), piece):
            first = min(start, len(rows) - piece)
            yield rows[first : first + piece], (int(num_poses), num_edges)


def _check_alike(graphs: Sequence[object]) -> list[PoseGraph]:
    checked = [check_graph(g, f"graph[{i}]") for i, g in enumerate(graphs)]
    for i, g in enumerate(checked):
        first = checked[0]
        if g.T_i_j.dtype != first.T_i_j.dtype:
            raise TypeError(
                f"graph[{i}]: wanted dtype {first.T_i_j.dtype} like graph[0], found "
                f"{g.T_i_j.dtype}."
            )
        if g.dim != first.dim:
            raise ValueError(
                f"graph[{i}]: wanted dimension {first.dim} like graph[0], found "
                f"{g.dim}."
            )
        if (g.information is None) != (first.information is None):
            raise ValueError(
                f"graph[{i}]: wanted information for all graphs or for none."
            )
    return checked


def _check_inits(init: object, graphs: list[PoseGraph]) -> list[Array] | None:
    if init is None:
        return None
    if not isinstance(init, list | tuple) or len(init) != len(graphs):
        found = len(init) if isinstance(init, list | tuple) else type(init).__name__
        raise ValueError(f"init: wanted a list of {len(graphs)}, found {found}.")
    checked = [
        check_init(T, g, f"init[{i}]")
        for i, (T, g) in enumerate(zip(init, graphs, strict=True))
    ]
    if any(T is None for T in checked):
        raise ValueError("init: wanted poses for all graphs or None for the list.")
    return [T for T in checked if T is not None]


def _padded(
    graphs: list[PoseGraph], inits: list[Array] | None, num_poses: int, num_edges: int
) -> tuple[PoseGraph, Array, Array | None]:
    """Graphs with a leading axis, which frames they have, and their starts."""
    # Built from a tree: fields with a leading axis are no PoseGraph's.
    same = [dataclasses.replace(g, num_poses=num_poses) for g in graphs]
    batch = jax.tree.map(lambda *x: stacked(x, num_edges), *same)
    counts = np.array([g.num_poses for g in graphs])
    present = jax.device_put(np.arange(num_poses) < counts[:, None])
    starts = None if inits is None else stacked(inits, num_poses)
    return batch, present, starts


@kept_program
def _average_lanes(
    method: AbstractAverager, lanes: _Lanes, batch_size: int, devices: Devices | None
) -> AveragingSolution:
    def one(lane: _Lanes) -> AveragingSolution:
        graph, present, init, key = lane
        if init is not None and present is not None:
            eye = jnp.eye(init.shape[-1], dtype=init.dtype)
            init = jnp.where(present[:, None, None], init, eye)
        return average_graph(graph, method, init, key, present)

    # Groups of one would be vectorised over an axis of one: conditions become selects.
    num = len(lanes[0].T_i_j)
    size = min(batch_size, num) if batch_size > 1 else None

    def some(lanes: _Lanes) -> AveragingSolution:
        return lax.map(one, lanes, batch_size=size)

    if devices is None:
        return some(lanes)
    return map_rows(devices, some, lanes)


def _cut(found: AveragingSolution, lane: int, graph: PoseGraph) -> AveragingSolution:
    """The solution of one graph without its padding."""
    v, e = graph.num_poses, graph.num_edges
    put = jax.device_put if is_concrete(found.status) else jnp.asarray
    return AveragingSolution(
        T_world_i=put(found.T_world_i[lane, :v]),
        edge_weight=put(found.edge_weight[lane, :e]),
        agreement=put(found.agreement[lane]),
        status=put(found.status[lane]),
        placed=put(found.placed[lane, :v]),
        component=put(found.component[lane, :v]),
        kernel_width=put(found.kernel_width[lane]),
        num_steps=put(found.num_steps[lane]),
        residual=put(found.residual[lane]),
        log_evidence=put(found.log_evidence[lane]),
        length_scale=put(found.length_scale[lane]),
        trace=jax.tree.map(lambda x: put(x[lane]), found.trace),
    )
