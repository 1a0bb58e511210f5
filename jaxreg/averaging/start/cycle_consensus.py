"""A robust start from the motions alone: the likeliest of many trees."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.checks import check_counts, is_concrete
from jaxreg._core.loop import AbstractIteration, iterate
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractStart,
    AveragingSolution,
    of_start,
    solution,
)
from jaxreg.averaging.likelihood import (
    SETTLED,
    Explained,
    Likelihood,
    least_after_fitting,
)
from jaxreg.averaging.start.cycles import edge_log_odds, judged
from jaxreg.averaging.start.settle import settled
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.shortest_paths import shortest_paths
from jaxreg.linear.laplacian import DENSE_LIMIT


# Perturbations of log odds, from a few in a hundred to all that cycles say. (On the
# scenes to choose on a ladder finds more than any one heat of it.)
_HEAT = (0.25, 2.0)


# Poses that are compared side by side, at most.
_GROUP = 12
# What ends a search: anything agrees, rounds without a gain, and the share of the trees
# of a round that leads to the likeliest poses. Of 93 generated graphs 42 then end early
# and none misses what 16 rounds find, from 0.15 to 0.5. After one round without a gain
# six of another 576 lose frames that few edges hold; after two, two do and three gain.
# A gain is one of so much log likelihood: settled poses go on to gain thousandths. (Any
# gain: half as many rounds again, and of 360 graphs one more is right. To end also
# where edges agree but `log_ratio` is below 0, as with half of few edges wrong, after
# four rounds, takes half of the time and loses four of them.)
_MEET = 0.25
_STILL = 2
_GAIN = 0.1


class CycleConsensus(AbstractStart):
    """Chains motions along edges that close cycles, and keeps the likeliest poses.

    Each edge gets log odds from its 3-cycles at several scales (`edge_log_odds`), and
    each scale the tree of greatest odds. They are compared by the likelihood of all
    motions (`explained`). Unless the best agrees with all edges that are trusted at
    some scale, further trees are drawn with randomly perturbed odds, round by round
    around the best so far; up to `DENSE_LIMIT` frames, their poses settle before they
    are compared. The search ends after two rounds without a gain if a quarter of the
    trees lead to the best poses.

    Graphs too large for cycles get the likelier of the tree of greatest prior weight
    and the one of shortest paths.

    `init` is ignored. Without `key` a fixed stream of random numbers is used.

    Attributes:
        hypotheses: drawn in each round, under one vmap (static).
        rounds: the largest number of rounds; half as many without a gain end the search
            in any case (static).
        max_cycles: graphs of more edges times frames are too large for cycles (static).

    Gradients: none; asking for them raises a TypeError.
    """

    hypotheses: int = eqx.field(static=True, default=32)
    rounds: int = eqx.field(static=True, default=16)
    max_cycles: int = eqx.field(static=True, default=1 << 20)

    def __check_init__(self) -> None:
        check_counts(self, hypotheses=1, rounds=1, max_cycles=0)

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Finds a start for a prepared graph; `edge_weight` is trust by cycles."""
        held = jax.lax.stop_gradient(graph)
        if not judged(held, self.max_cycles):
            return of_start(self, graph, _of_tree(held, _by_trees(held)))
        return of_start(self, graph, _with_trust(held, self._best(held, key)))

    def poses(self, graph: PoseGraph, key: Key | None) -> Float[Array, "v D D"]:
        """The likeliest poses, of a graph that is held: a start has no derivative."""
        if not judged(graph, self.max_cycles):
            return _by_trees(graph)
        return self._best(graph, key).T

    def _best(self, graph: PoseGraph, key: Key | None) -> "_Best":
        search = _Search(graph, self.hypotheses, self.rounds)
        best = search.init(key)
        # Most graphs are done: the search is compiled for one that is not.
        if not is_concrete(best.settled) or not best.settled:
            best = _searched(search, best)
        return best


class _Best(NamedTuple):
    """The likeliest poses so far."""

    T: Float[Array, "v D D"]
    found: Explained
    odds: Float[Array, "s e"]
    scale: Int[Array, ""]  # whose odds the first of them came from
    settled: Bool[Array, ""]
    idle: Int[Array, ""]  # rounds since the last gain
    num_steps: Int[Array, ""]  # rounds
    key: Key


class _Search(AbstractIteration[Key | None, _Best]):
    """Rounds of trees of perturbed odds around the best poses so far."""

    graph: PoseGraph
    hypotheses: int
    rounds: int

    @kept_program
    def init(self, start: Key | None) -> _Best:
        """The odds at each scale, and the best of their trees.

        Prior weights and short chains are hypotheses of their own.
        """
        graph = self.graph
        odds = edge_log_odds(graph)
        weights = jnp.concatenate([odds, graph.weight[None]])
        T = jax.vmap(lambda o: _forest(graph, o).T_world_i)(weights)
        T = jnp.concatenate([T, _shortest(graph, odds)[None]])
        chosen = _chosen(graph, odds, T)
        none = jnp.asarray(0, jnp.int32)
        return _Best(
            T=T[chosen.best],
            found=chosen.found,
            odds=odds,
            scale=jnp.minimum(chosen.best, len(odds) - 1),
            settled=chosen.settled,
            idle=none,
            num_steps=none,
            key=jax.random.key(0) if start is None else start,
        )

    def terminate(self, state: _Best) -> Bool[Array, ""]:
        return state.settled

    def fail(self, state: _Best) -> Bool[Array, ""]:
        return state.idle >= (self.rounds + 1) // 2

    def step(self, state: _Best) -> _Best:
        """Trees of perturbed odds: factors exchange safe edges, terms doubtful ones.

        From cold ones, which stay near the best poses, to hot ones.
        """
        graph, best, odds = self.graph, state, state.odds
        likelihood = Likelihood.of(graph)
        key, now = jax.random.split(best.key)
        heat = jnp.geomspace(*_HEAT, self.hypotheses, dtype=odds.dtype)[:, None]
        noise = _noise(now, graph.num_edges, self.hypotheses, odds.dtype)
        each = odds[jnp.arange(self.hypotheses) % odds.shape[0]]
        each = jnp.exp(heat * noise[0]) * each + 2 * heat * noise[1]
        # What contradicts the best poses loses nothing: chains of them drift.
        each = each + jax.nn.softplus(best.found.log_odds)[None]
        T = jax.vmap(lambda o: _forest(graph, o).T_world_i)(each)
        T = jnp.concatenate([best.T[None], T])
        if graph.num_poses <= DENSE_LIMIT:
            T, found = jax.vmap(lambda T: settled(likelihood, T))(T)
        else:
            found = _explained(likelihood, T)
        likeliest = jnp.argmax(found.log_ratio)
        gain = found.log_ratio[likeliest] - best.found.log_ratio
        better = gain > 0
        ratios = found.log_ratio[1:]
        T_best, found = jax.tree.map(
            lambda new, old: jnp.where(better, new[likeliest], old),
            (T, found),
            (best.T, best.found),
        )
        meets = jnp.mean(ratios > least_after_fitting(found), dtype=odds.dtype)
        idle = jnp.where(gain > _GAIN, 0, best.idle + 1)
        return best._replace(
            T=T_best,
            found=found,
            settled=(found.log_ratio > 0) & (meets >= _MEET) & (idle >= _STILL),
            idle=idle,
            num_steps=best.num_steps + 1,
            key=key,
        )


def _noise(
    key: Key, num_edges: int, hypotheses: int, dtype: jnp.dtype
) -> Float[Array, "2 h e"]:
    """Logistic; that of an edge is the same whatever edges there are behind it."""

    def of_edge(edge: Array) -> Array:
        own = jax.random.fold_in(key, edge)
        return jax.random.logistic(own, (2, hypotheses), dtype)

    return jax.vmap(of_edge, out_axes=2)(jnp.arange(num_edges, dtype=jnp.uint32))


@kept_program
def _by_trees(graph: PoseGraph) -> Float[Array, "v D D"]:
    args = (graph.edges, graph.T_i_j, graph.weight, graph.num_poses)
    T = jnp.stack(
        [
            shortest_paths(*args).T_root_i,
            trees.maximum_spanning_tree(*args).T_world_i,
        ]
    )
    return T[jnp.argmax(_explained(Likelihood.of(graph), T).log_ratio)]


@kept_program
def _of_tree(graph: PoseGraph, T_world_i: Float[Array, "v D D"]) -> AveragingSolution:
    return solution(graph, T_world_i, num_steps=0)


@kept_program
def _searched(search: _Search, best: _Best) -> _Best:
    return iterate(search, best, max_steps=search.rounds).state


@kept_program
def _with_trust(graph: PoseGraph, best: _Best) -> AveragingSolution:
    trust = jnp.where(graph.weight > 0, jax.nn.sigmoid(best.odds[best.scale]), 0)
    return solution(graph, best.T, edge_weight=trust, num_steps=best.num_steps)


def _explained(likelihood: Likelihood, T: Float[Array, "m v D D"]) -> Explained:
    """How each of some poses explains the motions."""
    return control.grouped_map(likelihood.explained, T, _GROUP)


def _forest(graph: PoseGraph, odds: Array) -> trees.Forest:
    """The tree of greatest odds: no path has a safer weakest edge."""
    present = graph.weight > 0
    low = jnp.min(jnp.where(present, odds, jnp.inf))
    weight = jnp.where(present, odds - low + 1, 0)
    return trees.maximum_spanning_tree(
        graph.edges, graph.T_i_j, weight, graph.num_poses
    )


def _shortest(graph: PoseGraph, odds: Array) -> Array:
    """Poses along the most probable path from frame 0 to each frame, coarsest odds."""
    doubt = jnp.clip(jax.nn.softplus(-odds[0]), 0.01, 10)  # -log of the trust
    weight = jnp.where(graph.weight > 0, 1 / doubt, 0)
    return shortest_paths(graph.edges, graph.T_i_j, weight, graph.num_poses).T_root_i


class _Chosen(NamedTuple):
    """Of some poses.

    Attributes:
        num_judged: poses, then scales by which the best of them are judged.
        best: the likeliest.
        found: how they explain the motions.
        placed: `(v,)` which frames edges join to frame 0.
        settled: whether trusted edges reach every such frame, and hardly any of them
            contradicts the poses.
    """

    num_judged: Int[Array, ""]
    best: Int[Array, ""]
    found: Explained
    placed: Bool[Array, " v"]
    settled: Bool[Array, ""]


def _chosen(
    graph: PoseGraph, odds: Float[Array, "s e"], T: Float[Array, "m v D D"]
) -> _Chosen:
    """The likeliest of some poses, and whether they need no search.

    All edges judge the poses one after another, and those that are trusted at a scale
    the best: noise may leave few at the finest, and the first answers as a rule. All in
    one loop, as what judges takes long to compile.
    """
    weight, num = graph.weight, len(T)
    trusted = jnp.where(odds > 0, weight[None], 0)

    def judge(so_far: _Chosen) -> _Chosen:
        k, best = so_far.num_judged, so_far.best
        is_poses = k < num
        by = jnp.where(is_poses, weight, trusted[jnp.maximum(k - num, 0)])
        likelihood = Likelihood.of(eqx.tree_at(lambda g: g.weight, graph, by))
        told = likelihood.explained(T[jnp.where(is_poses, k, best)])
        first, joined = k == 0, trees.components(graph.edges, by, graph.num_poses) == 0
        placed = jnp.where(first, joined, so_far.placed)
        better = first | (is_poses & (told.log_ratio > so_far.found.log_ratio))
        agree = likelihood.agreed_share(told) > SETTLED
        return _Chosen(
            num_judged=k + 1,
            best=jnp.where(better, k, best),
            found=jax.tree.map(
                lambda new, old: jnp.where(better, new, old), told, so_far.found
            ),
            placed=placed,
            settled=~is_poses & agree & jnp.all(joined | ~placed),
        )

    none, zero = jnp.asarray(0, jnp.int32), jnp.zeros((), weight.dtype)
    nothing = Explained(zero, zero, jnp.zeros_like(weight))
    no_frames = jnp.zeros(graph.num_poses, bool)
    return control.while_loop(
        lambda s: ~s.settled & (s.num_judged < num + len(odds)),
        judge,
        _Chosen(none, none, nothing, no_frames, jnp.asarray(False)),
    )
