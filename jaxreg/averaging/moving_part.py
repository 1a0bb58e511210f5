"""Part of a graph that moves while the frames around it stand still.

Poses of the part are a minimum under the kernel that the whole was averaged with, given
the frames around it: those are one frame, the world, as `anchored` has it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.methods.graduated import last_kernel
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.batching.padding import lengthened, rounded_up
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses, anchored
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.robust import Welsch


# Neighbours of neighbours that move from the start, and how many times more frames move
# where these were too few: geometric, so that all tries together cost twice the last.
_RINGS, _MORE = 2, 4
# Outermost frames that move by no more than this share of the deviation of an edge
# stand still: as much lies between averaging 1,000 poses anew and from their poses.
_STILL = 0.03


class Part(NamedTuple):
    """A graph on the host, of which some frames move under the kernel of the whole."""

    edges: np.ndarray  # (e, 2)
    T_i_j: np.ndarray
    weight: np.ndarray
    information: np.ndarray  # (e, k, k), or (1, k, k) where all have the same
    trusted: np.ndarray  # (e,) by the solution before, and new edges
    num_poses: int
    num_before: tuple[int, int]  # frames and edges
    deviations: np.ndarray  # (2,) of a component of a translation and of a rotation
    width: np.ndarray  # of the kernel, over them

    @classmethod
    def of(cls, graph: PoseGraph, previous: AveragingSolution) -> "Part":
        """From a solution of its first frames and edges, by `Correntropy`."""
        before = len(previous.T_world_i), len(previous.edge_weight)
        deviations, width = last_kernel(previous)
        edges, T_i_j, weight, info = on_host(graph)
        trusted = weight > 0
        trusted[: before[1]] &= np.asarray(previous.edge_weight) > 0.5
        if info is None:  # that of `precisions`
            d, k = graph.dim, lie.tangent_dim(graph.dim)
            shift = (deviations[1] / deviations[0]) ** 2
            info = np.diag(np.repeat([shift, 1], [d, k - d])).astype(T_i_j.dtype)[None]
        return cls(
            edges,
            T_i_j,
            weight,
            info,
            trusted,
            graph.num_poses,
            before,
            deviations,
            width,
        )

    def touched(self) -> np.ndarray:
        """New frames, ends of new edges, and those near them."""
        frames, edges = self.num_before
        active = np.arange(self.num_poses) >= frames
        active[self.edges[edges:][self.weight[edges:] > 0]] = True
        for _ in range(_RINGS):
            active = self._widened(active)
        return active

    def more(self, active: np.ndarray) -> np.ndarray:
        """Ring by ring, until they are so many times more."""
        wanted, count = _MORE * np.count_nonzero(active), 0
        while count < np.count_nonzero(active) < wanted:
            count = np.count_nonzero(active)
            active = self._widened(active)
        return active

    def _widened(self, active: np.ndarray) -> np.ndarray:
        """With the neighbours of all; frame 0 stays where it is."""
        edges = self.edges[self.trusted]
        wider = active.copy()
        wider[edges[active[edges].any(axis=1)]] = True
        wider[0] = False
        return wider

    def is_still(
        self, T_before: np.ndarray, T_after: np.ndarray, active: np.ndarray
    ) -> bool:
        """Whether the outermost of the frames that may move hardly do."""
        edges = self.edges[self.trusted]
        apart = active[edges[:, 0]] != active[edges[:, 1]]
        ends = edges[apart]
        ends = ends[np.all(ends > 0, axis=1)]
        rim = np.unique(ends[active[ends]])
        change = T_after[rim] - T_before[rim]
        shift = np.linalg.norm(change[:, :-1, -1], axis=-1)
        turn = np.linalg.norm(change[:, :-1, :-1], axis=(1, 2)) / 2**0.5
        most = _STILL * self.deviations
        return bool(np.all(shift <= most[0]) and np.all(turn <= most[1]))

    def settled(self, T: np.ndarray, active: np.ndarray) -> np.ndarray | None:
        """Poses after some frames moved; None where that cost an edge its trust."""
        if not active.any():
            return T
        rows = np.flatnonzero(active[self.edges].any(axis=1) & (self.weight > 0))
        frames, ends = np.unique(self.edges[rows], return_inverse=True)
        moves = active[frames]
        # Lengths from a frame nearby: coordinates far from the world's have no digits.
        T_world_near = T[frames[np.argmin(moves)]]
        T_near_i = np.linalg.inv(T_world_near) @ T[frames]
        info = self.information
        info = info[rows] if len(info) > 1 else np.repeat(info, len(rows), axis=0)
        num_poses = rounded_up(len(frames), 8, 2)
        num_edges = rounded_up(len(rows), 16, 2)
        part = PoseGraph(
            edges=lengthened(ends.reshape(-1, 2).astype(np.int32), num_edges),
            T_i_j=_posed(self.T_i_j[rows], num_edges),
            weight=lengthened(self.weight[rows], num_edges),
            mask=lengthened(np.ones(len(rows), bool), num_edges),
            information=lengthened(info, num_edges),
            num_poses=num_poses,
        )
        start = _posed(T_near_i.astype(T.dtype), num_poses)
        moving = lengthened(moves, num_poses)
        fixed = lengthened(~moves, num_poses)
        method = PoseGraphLM(kernel=Welsch(), kernel_width=jnp.asarray(self.width))
        found, trust, sound = jax.device_get(
            _settled(part, method, start, moving, fixed)
        )
        lost = self.trusted[rows] & (trust[: len(rows)] < 0.5)
        if np.any(lost) or not sound:
            return None
        T = T.copy()
        T[frames[moves]] = T_world_near @ found[: len(frames)][moves]
        return T


@kept_program
def _settled(
    graph: PoseGraph,
    method: PoseGraphLM,
    T_world_i: Float[Array, "v D D"],
    moving: Bool[Array, " v"],
    fixed: Bool[Array, " v"],
) -> tuple[Float[Array, "v D D"], Float[Array, " e"], Bool[Array, ""]]:
    """Poses, trust, and whether the steps came to rest."""
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    dtype = T_world_i.dtype
    known = KnownPoses(
        frame=jnp.zeros(0, jnp.int32),
        mask=jnp.zeros(0, bool),
        T_world_prior=jnp.zeros((0, d + 1, d + 1), dtype),
        information=jnp.zeros((0, k, k), dtype),
        fixed=fixed,
        T_world_fixed=T_world_i,
    )
    start = jnp.concatenate([jnp.eye(d + 1, dtype=dtype)[None], T_world_i])
    present = jnp.append(True, moving)
    end = average_graph(anchored(graph, known), method, start, None, present)
    # Few edges may agree with each other by chance: not asked of a part.
    sound = (end.status == Status.CONVERGED) | (end.status == Status.NO_AGREEMENT)
    return end.T_world_i[1:], end.edge_weight, sound


def on_host(
    graph: PoseGraph,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Edges, motions, weights that are 0 where masked, and the information."""
    info = None if graph.information is None else np.asarray(graph.information)
    weight = np.where(graph.mask, graph.weight, 0)
    return np.asarray(graph.edges), np.asarray(graph.T_i_j), weight, info


def _posed(T: np.ndarray, num: int) -> Array:
    """Poses, and the identity behind them."""
    out = np.broadcast_to(np.eye(T.shape[-1], dtype=T.dtype), (num, *T.shape[1:]))
    out = out.copy()
    out[: len(T)] = T
    return jax.device_put(out)
