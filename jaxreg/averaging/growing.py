"""A graph that has grown: what is new is averaged, and what it moves.

Most of what is added to a map bends little of it. So the new frames, the ends of new
edges and frames near them move, by Levenberg-Marquardt under the kernel that the whole
graph was averaged with, while the frames around them stand still. Where the outermost
of them move, more are taken in, four times as many each time, up to the whole graph.

What this cannot judge is averaged anew: edges that the poses contradict may be wrong,
or ask for a bend of all that lies between their ends, and only the whole tells.

Reference: Kaess et al. 2012, "iSAM2: incremental smoothing and mapping using the Bayes
tree" (what a new measurement does not reach is not computed again).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import is_concrete, shown
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, solution
from jaxreg.averaging.many import average_rounded
from jaxreg.averaging.methods.correntropy import Correntropy
from jaxreg.averaging.methods.graduated import (
    kernel_trust,
    reported_width,
)
from jaxreg.averaging.moving_part import Part, on_host
from jaxreg.graph.pose_graph import PoseGraph, check_graph
from jaxreg.linear.laplacian import DENSE_LIMIT
from jaxreg.linear.small import product


# More new frames than these are worth a start from the motions alone.
_MOST_NEW = 1024


def check_previous(
    previous: object, graph: object, beside: dict[str, object]
) -> PoseGraph:
    """Requires a solution of the first part of one graph, and nothing beside it."""
    if not isinstance(previous, AveragingSolution):
        raise TypeError(
            f"previous: wanted an AveragingSolution, found {shown(previous)}."
        )
    for name, found in beside.items():
        if found is not None:
            raise ValueError(f"{name}: wanted None beside `previous`.")
    many = isinstance(graph, list | tuple)
    if many or (isinstance(graph, PoseGraph) and graph.edges.ndim == 3):
        raise ValueError("previous: of one graph, found many graphs.")
    one = check_graph(graph, "graph")
    if not all(map(is_concrete, jax.tree.leaves((one, previous)))):
        raise ValueError(
            "previous: how much of a graph is averaged depends on the values, which "
            "are not known under jit, vmap and grad; give `init` there."
        )
    if previous.prior_weight is not None:
        raise ValueError("previous: wanted a solution without priors and the like.")
    num, D = len(previous.T_world_i), one.dim + 1
    if previous.T_world_i.shape[1:] != (D, D):
        raise ValueError(
            f"previous: T_world_i: wanted shape (v, {D}, {D}), found "
            f"{previous.T_world_i.shape}."
        )
    if num > one.num_poses or len(previous.edge_weight) > one.num_edges:
        raise ValueError(
            f"previous: wanted at most {one.num_poses} frames and {one.num_edges} "
            f"edges, found {num} and {len(previous.edge_weight)}."
        )
    if previous.T_world_i.dtype != one.T_i_j.dtype:
        raise ValueError(
            f"previous: wanted dtype {one.T_i_j.dtype} like the graph, found "
            f"{previous.T_world_i.dtype}."
        )
    return one


def average_grown(
    graph: PoseGraph,
    method: AbstractAverager,
    previous: AveragingSolution,
    key: Key | None,
) -> AveragingSolution:
    """`average` from a solution of the first frames and edges, all checked."""
    start = _chained(graph, previous)
    if start is not None:
        if not isinstance(method, Correntropy) or graph.num_poses <= DENSE_LIMIT:
            return average_rounded(graph, method, jax.device_put(start), key)
        if len(previous.T_world_i) > DENSE_LIMIT:
            found = _grown(graph, previous, start)
            if found is not None:
                return found
    found = average_rounded(graph, method, None, key)
    T_world_0 = previous.T_world_i[0]
    placed = found.placed[:, None, None]
    T = jnp.where(placed, product(T_world_0, found.T_world_i), found.T_world_i)
    return eqx.tree_at(lambda s: s.T_world_i, found, T)


def _grown(
    graph: PoseGraph, previous: AveragingSolution, T: np.ndarray
) -> AveragingSolution | None:
    """From poses of all frames; None where edges contradict them."""
    part = Part.of(graph, previous)
    active, still = part.touched(), False
    while not still:
        # Of more than half, the next try would be the whole.
        whole = 2 * np.count_nonzero(active) > graph.num_poses
        active = np.arange(graph.num_poses) > 0 if whole else active
        found = part.settled(T, active)
        if found is None:
            return None
        still = whole or part.is_still(T, found, active)
        T, active = found, part.more(active)
    judge = _Judge(jnp.asarray(part.deviations), jnp.asarray(part.width))
    end = average_rounded(graph, judge, jax.device_put(T), None)
    return eqx.tree_at(
        lambda s: s.trace, end, previous.trace, is_leaf=lambda x: x is None
    )


class _Judge(AbstractAverager):
    """Poses as they are, judged by the kernel of a solution before."""

    deviations: Float[Array, "2"]
    width: Float[Array, ""]

    @kept_program
    def solve(
        self, graph: PoseGraph, init: Float[Array, "v D D"] | None, key: Key | None
    ) -> AveragingSolution:
        """The solution at `init`."""
        assert init is not None
        trust = kernel_trust(self.deviations, self.width, graph, init)
        width = reported_width(self.deviations)
        return solution(graph, init, edge_weight=trust, kernel_width=width)


def _chained(graph: PoseGraph, previous: AveragingSolution) -> np.ndarray | None:
    """The poses before, and new ones chained to them; None where that cannot be."""
    num, old = graph.num_poses, np.asarray(previous.T_world_i)
    known = len(old)
    sound = previous.status == Status.CONVERGED and bool(previous.placed.all())
    if not sound or num - known > min(known, _MOST_NEW):
        return None
    edges, T_i_j, weight, _ = on_host(graph)
    rows = np.flatnonzero((edges >= known).any(axis=1) & (weight > 0))
    edges, T_i_j = edges[rows], T_i_j[rows]
    # A recording seldom slips between one frame and the next.
    order = np.argsort(np.abs(edges[:, 0] - edges[:, 1]) != 1, kind="stable")
    ends = np.concatenate([edges[order], edges[order, ::-1]])
    T_a_b = np.concatenate([T_i_j[order], np.linalg.inv(T_i_j[order])])
    T = np.zeros((num, *old.shape[1:]), old.dtype)
    T[:known], placed = old, np.arange(num) < known
    while not placed.all():
        next_ones = np.flatnonzero(placed[ends[:, 0]] & ~placed[ends[:, 1]])
        frames, first = np.unique(ends[next_ones, 1], return_index=True)
        if not len(frames):
            return None
        e = next_ones[first]
        T[frames] = T[ends[e, 0]] @ T_a_b[e]
        placed[frames] = True
    return T
