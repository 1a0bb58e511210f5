"""A robust start from the motions alone: the best of many trees through the graph."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.checks import check_counts, is_concrete
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    length_scale,
    solution,
)
from jaxreg.averaging.evidence import (
    agreement,
    coherence,
    squared_errors,
)
from jaxreg.averaging.start.cycles import edge_log_odds, judged
from jaxreg.averaging.start.long_cycles import long_cycle_odds
from jaxreg.averaging.start.moves import frames_moved, groups_moved, settled
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.laplacian import DENSE_LIMIT


_AGREES = 0.1
# Odds are perturbed by factors, which exchange safe edges, and by terms, which exchange
# doubtful ones; agreement with the best so far adds to them.
_FACTOR, _TERM, _TOWARD_BEST = 1.0, 2.0, 10.0
# The search ends after so many rounds without a better hypothesis.
_PATIENCE = 6
# Hypotheses of a round that settle before they are compared with the best so far.
_SETTLED = 8


class CycleConsensus(AbstractAverager):
    """Chains motions along edges that close cycles, and keeps the best tree.

    Each edge gets log odds from its 3-cycles at several scales (`edge_log_odds`), and
    each scale the tree of greatest odds. If the best contradicts believed edges, or
    some frame is reached by doubtful edges alone, long cycles are asked as well
    (`long_cycle_odds`). Where that does not settle it, further trees are drawn with
    randomly perturbed odds, round by round around the best so far, and the best is
    changed by moving single frames, and groups beyond an edge of a tree, to where most
    of their edges put them. All are compared by how well frames agree with those next
    to them (`coherence`), over a ladder of scales: no noise level is needed. Up to
    `DENSE_LIMIT` frames, the best of a round settle and are compared once more.

    Graphs too large for cycles get the better of the tree of greatest prior weight and
    the one of shortest paths, by the number of edges that agree.

    `init` is ignored. Without `key` a fixed stream of random numbers is used.

    Attributes:
        hypotheses: drawn in each round, under one vmap (static).
        rounds: the largest number of rounds (static).

    Gradients: none (the start is cut).
    """

    hypotheses: int = eqx.field(static=True, default=32)
    rounds: int = eqx.field(static=True, default=12)

    def __check_init__(self) -> None:
        check_counts(self, hypotheses=1, rounds=1)

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Finds a start for a prepared graph; `edge_weight` is the belief in edges."""
        if not judged(graph):
            return _by_trees(graph)
        found = self._begun(graph, key)
        # Most graphs are done: the search is compiled for one that is not.
        if not is_concrete(found.search.settled) or not found.search.settled:
            found = self._searched(graph, found)
        return _believed(graph, found)

    @eqx.filter_jit
    def _begun(self, graph: PoseGraph, key: Key | None) -> "_Found":
        graph = jax.lax.stop_gradient(graph)
        scale, odds = length_scale(graph), edge_log_odds(graph)
        # Prior weights and short chains are hypotheses of their own.
        weights = jnp.concatenate([odds, graph.weight[None]])
        T = jax.vmap(lambda o: _forest(graph, o).T_world_i)(weights)
        T = jnp.concatenate([T, _shortest(graph, odds)[None]])
        score = jax.vmap(lambda T: coherence(graph, T, scale))(T)
        best = jnp.argmax(score)
        search = _Search(
            T=T[best],
            score=score[best],
            settled=_is_settled(graph, odds, T[best], scale),
            idle=jnp.asarray(0, jnp.int32),
            round=jnp.asarray(0, jnp.int32),
            key=jax.random.key(0) if key is None else key,
        )
        own = odds[jnp.minimum(best, odds.shape[0] - 1)]
        return _Found(search, T, odds, own)

    @eqx.filter_jit
    def _searched(self, graph: PoseGraph, begun: "_Found") -> "_Found":
        graph = jax.lax.stop_gradient(graph)
        scale = length_scale(graph)
        begun = _by_long_cycles(graph, begun, scale)

        def unfinished(s: _Search) -> Array:
            return ~s.settled & (s.round < self.rounds) & (s.idle < _PATIENCE)

        def step(s: _Search) -> _Search:
            return self._round(graph, begun.odds, scale, begun.starts, s)

        return begun._replace(search=jax.lax.while_loop(unfinished, step, begun.search))

    def _round(
        self, graph: PoseGraph, odds: Array, scale: Array, starts: Array, s: "_Search"
    ) -> "_Search":
        key, now, pick = jax.random.split(s.key, 3)
        shape = (2, self.hypotheses, graph.num_edges)
        noise = jax.random.logistic(now, shape, odds.dtype)
        each = odds[jnp.arange(self.hypotheses) % odds.shape[0]]
        each = jnp.exp(_FACTOR * noise[0]) * each + _TERM * noise[1]
        each = each + _TOWARD_BEST * _holds(graph, s.T, scale)
        drawn = jax.vmap(lambda o: _forest(graph, o))(each)
        tree, most = drawn.in_tree[0], self.hypotheses
        across = groups_moved(graph, s.T, scale, tree, odds[0], pick, most)
        single = frames_moved(graph, s.T, scale, self.hypotheses)
        T = jnp.concatenate([starts, drawn.T_world_i, single, across])
        score = jax.vmap(lambda T: coherence(graph, T, scale))(T)
        if graph.num_poses <= DENSE_LIMIT:
            # The starts settle in the first round, later the best.
            start = (s.round == 0) & (jnp.arange(len(T)) < starts.shape[0])
            chosen = jax.lax.top_k(jnp.where(start, jnp.inf, score), _SETTLED)[1]
            fine = jax.vmap(lambda T: settled(graph, T, scale))(T[chosen])
            finer = jax.vmap(lambda T: coherence(graph, T, scale))(fine)
            finer = jnp.where(jnp.isfinite(finer), finer, -jnp.inf)
            T, score = jnp.concatenate([T, fine]), jnp.concatenate([score, finer])
        best = jnp.argmax(score)
        better = score[best] > s.score
        return _Search(
            T=jnp.where(better, T[best], s.T),
            score=jnp.maximum(score[best], s.score),
            settled=s.settled,
            idle=jnp.where(better, 0, s.idle + 1),
            round=s.round + 1,
            key=key,
        )


def _by_long_cycles(graph: PoseGraph, found: "_Found", scale: Array) -> "_Found":
    """With the trees that long cycles confirm as further starts, if there is doubt."""

    def grown() -> _Found:
        s = found.search
        key, grow = jax.random.split(s.key)
        odds = long_cycle_odds(graph, found.odds[0], grow)
        likely = jnp.where(graph.weight > 0, jax.nn.sigmoid(found.odds[0]), 0)
        T = jax.vmap(lambda o: _forest(graph, o + likely).T_world_i)(odds)
        score = jax.vmap(lambda T: coherence(graph, T, scale))(T)
        best = jnp.argmax(score)
        better = score[best] > s.score
        search = s._replace(
            T=jnp.where(better, T[best], s.T),
            score=jnp.maximum(score[best], s.score),
            settled=better & _is_settled(graph, odds, T[best], scale),
            key=key,
        )
        return _Found(
            search,
            jnp.concatenate([found.starts, T]),
            jnp.concatenate([found.odds, odds]),
            jnp.where(better, odds[best], found.own),
        )

    def kept() -> _Found:
        # Nothing looks at the rows that are added.
        shapes = jax.eval_shape(grown)
        starts = jnp.resize(found.starts, shapes.starts.shape)
        return _Found(
            found.search, starts, jnp.resize(found.odds, shapes.odds.shape), found.own
        )

    # Under a caller's `jit` also graphs that are settled come here.
    return jax.lax.cond(found.search.settled, kept, grown)


class _Search(NamedTuple):
    T: Array
    score: Array
    settled: Array
    idle: Array  # rounds since the last gain
    round: Array
    key: Array


class _Found(NamedTuple):
    search: _Search
    starts: Array
    odds: Array
    own: Array  # the odds of the scale of the best start


@eqx.filter_jit
def _by_trees(graph: PoseGraph) -> AveragingSolution:
    graph = jax.lax.stop_gradient(graph)
    return solution(graph, _without_cycles(graph), num_steps=0)


@eqx.filter_jit
def _believed(graph: PoseGraph, found: _Found) -> AveragingSolution:
    graph = jax.lax.stop_gradient(graph)
    belief = jnp.where(graph.weight > 0, jax.nn.sigmoid(found.own), 0)
    rounds = found.search.round
    return solution(graph, found.search.T, edge_weight=belief, num_steps=rounds)


def _forest(graph: PoseGraph, odds: Array) -> trees.Forest:
    """The tree of greatest odds: no path has a safer weakest edge."""
    present = graph.weight > 0
    low = jnp.min(jnp.where(present, odds, jnp.inf))
    weight = jnp.where(present, odds - low + 1, 0)
    return trees.maximum_spanning_tree(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    )


def _heaviest(graph: PoseGraph) -> Array:
    return trees.maximum_spanning_tree(
        graph.edges, graph.T_i_j, graph.weight, graph.num_poses
    ).T_world_i


def _shortest(graph: PoseGraph, odds: Array) -> Array:
    """Poses along the most probable path from frame 0 to each frame, coarsest odds."""
    doubt = jnp.clip(jax.nn.softplus(-odds[0]), 0.01, 10)  # -log of the belief
    weight = jnp.where(graph.weight > 0, 1 / doubt, 0)
    return trees.shortest_paths(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    ).T_root_i


def _without_cycles(graph: PoseGraph) -> Array:
    heaviest, scale = _heaviest(graph), length_scale(graph)
    paths = trees.shortest_paths(
        graph.edges, graph.T_i_j, graph.weight, graph.num_poses
    ).T_root_i
    better = agreement(graph, paths, scale) >= agreement(graph, heaviest, scale)
    return jnp.where(better, paths, heaviest)


def _holds(graph: PoseGraph, T_world_i: Array, scale: Array) -> Array:
    return jnp.exp(-squared_errors(graph, T_world_i, scale) / (2 * _AGREES**2))


def _is_settled(graph: PoseGraph, odds: Array, T: Array, scale: Array) -> Array:
    """True if believed edges reach every frame and hardly any contradicts the poses.

    The edges believed at any one scale: noise may leave few at the finest.
    """
    placed = trees.components(graph.edges, graph.weight, graph.num_poses) == 0
    contradicted = _holds(graph, T, scale) < 0.5

    def at_scale(odds: Array) -> Array:
        believed = jnp.where(odds > 0, 1, 0).astype(odds.dtype)
        component = trees.components(graph.edges, believed, graph.num_poses)
        reached = jnp.all((component == 0) | ~placed)
        return reached & (jnp.sum(believed * contradicted) <= 0.02 * jnp.sum(believed))

    return jnp.any(jax.vmap(at_scale)(odds))
