"""A robust start from the motions alone: the best of many paths through the graph."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    length_scale,
    solution,
)
from jaxreg.averaging.cycles import edge_log_odds, judged
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


_SCALES = tuple(0.5 / 2**k for k in range(8))
_AGREES = 0.1


class CycleConsensus(AbstractAverager):
    """Chains motions along edges that close cycles, and keeps the best agreed chain.

    Each edge gets log odds from its 3-cycles (`edge_log_odds`). Every frame is reached
    by its most probable path from frame 0. If the result contradicts believed edges,
    or some frame is reached by doubtful edges alone, further hypotheses are drawn with
    randomly perturbed odds, round by round around the best so far, and scored by how
    many edges agree with them on a ladder of scales, so no noise level is needed.

    `init` is ignored. Without `key` a fixed stream of random numbers is used.

    Attributes:
        hypotheses: drawn in each round, under one vmap (static).
        rounds: the largest number of rounds (static).

    Gradients: none (the start is cut).
    """

    hypotheses: int = eqx.field(static=True, default=16)
    rounds: int = eqx.field(static=True, default=6)

    def __check_init__(self) -> None:
        for name in ("hypotheses", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: wanted at least 1.")

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Finds a start for a prepared graph; `edge_weight` is the belief in edges."""
        graph = jax.lax.stop_gradient(graph)
        scale, odds = length_scale(graph), edge_log_odds(graph)
        first = _chain(graph, odds)
        score = agreement(graph, first, scale)
        # Prior weights are evidence too: the heaviest tree is a hypothesis of its own.
        tree = trees.maximum_spanning_tree(
            graph.edges, graph.T_i_j, graph.weight, graph.num_poses
        ).T_world_i
        tree_score = agreement(graph, tree, scale)
        first = jnp.where(tree_score > score, tree, first)
        start = _Search(
            T=first,
            score=jnp.maximum(score, tree_score),
            # Without cycles there is no belief to draw hypotheses by.
            settled=_is_settled(graph, odds, first, scale) | (not judged(graph)),
            round=jnp.asarray(0, jnp.int32),
            key=jax.random.key(0) if key is None else key,
        )

        def step(s: _Search) -> _Search:
            return self._round(graph, odds, scale, s)

        end = jax.lax.while_loop(
            lambda s: ~s.settled & (s.round < self.rounds), step, start
        )
        belief = jnp.where(graph.weight > 0, jax.nn.sigmoid(odds), 0)
        return solution(graph, end.T, edge_weight=belief, num_steps=end.round)

    def _round(
        self, graph: PoseGraph, odds: Array, scale: Array, s: "_Search"
    ) -> "_Search":
        key, now = jax.random.split(s.key)
        shape = (self.hypotheses, graph.num_edges)
        noise = 2 * jax.random.logistic(now, shape, odds.dtype)
        toward_best = 3 * _agrees(graph, s.T, scale)
        T = jax.vmap(lambda n: _chain(graph, odds + toward_best + n))(noise)
        score = jax.vmap(lambda T: agreement(graph, T, scale))(T)
        best = jnp.argmax(score)
        better = score[best] > s.score
        return _Search(
            T=jnp.where(better, T[best], s.T),
            score=jnp.maximum(score[best], s.score),
            settled=s.settled,
            round=s.round + 1,
            key=key,
        )


class _Search(NamedTuple):
    T: Array
    score: Array
    settled: Array
    round: Array
    key: Array


def _chain(graph: PoseGraph, odds: Array) -> Array:
    """Poses along the most probable path from frame 0 to each frame."""
    doubt = jnp.clip(jax.nn.softplus(-odds), 0.01, 10)  # -log of the belief
    weight = jnp.where(graph.weight > 0, 1 / doubt, 0)
    return trees.shortest_path_poses(graph.edges, graph.T_i_j, weight, graph.num_poses)[
        0
    ]


def agreement(graph: PoseGraph, T_world_i: Array, scale: Array) -> Array:
    """Edges that agree, by prior weight, summed over a ladder of kernel widths."""
    rotation, translation = graph.differences(T_world_i)
    sq = rotation / 2 + translation / scale**2
    total = jnp.zeros((), sq.dtype)
    for width in _SCALES:
        total = total + jnp.sum(graph.weight * jnp.exp(-sq / (2 * width**2)))
    return total


def redundancy(graph: PoseGraph, T_world_i: Array) -> Array:
    """Edges that agree beyond those that any tree agrees with, over the same ladder.

    A chain of motions agrees with its own edges, however far it drifts.
    """
    rotation, translation = graph.differences(T_world_i)
    sq = rotation / 2 + translation / length_scale(graph) ** 2
    present = graph.weight > 0
    usual = jnp.sum(graph.weight) / jnp.maximum(jnp.sum(present), 1)
    free = (graph.num_poses - 1) * usual
    total = jnp.zeros((), sq.dtype)
    for width in _SCALES:
        agreed = jnp.sum(graph.weight * jnp.exp(-sq / (2 * width**2)))
        total = total + jnp.maximum(agreed - free, 0)
    return total


def _agrees(graph: PoseGraph, T_world_i: Array, scale: Array) -> Array:
    rotation, translation = graph.differences(T_world_i)
    return jnp.exp(-(rotation / 2 + translation / scale**2) / (2 * _AGREES**2))


def _is_settled(graph: PoseGraph, odds: Array, T: Array, scale: Array) -> Array:
    """True if believed edges reach every frame and hardly any contradicts the poses."""
    believed = jnp.where(odds > 0, 1, 0).astype(odds.dtype)
    component = trees.components(graph.edges, believed, graph.num_poses)
    placed = trees.components(graph.edges, graph.weight, graph.num_poses) == 0
    reached = jnp.all((component == 0) | ~placed)
    doubtful = jnp.sum(believed * (_agrees(graph, T, scale) < 0.5))
    return reached & (doubtful <= 0.02 * jnp.sum(believed))
