"""From relative motions to poses: which pairs to trust, and which scans they place."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar, StatusArray
from jaxreg.averaging import (
    AbstractAverager,
    AveragingTrace,
    Correntropy,
    SpanningTree,
    average,
)
from jaxreg.geometry import lie
from jaxreg.graph.hang import with_hung
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import components
from jaxreg.multiview.choose_pairs import most_tries
from jaxreg.multiview.parts import part_numbers, part_sizes
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import (
    AGREES,
    Joining,
    displacement,
    joins,
    likely,
    prior_weight,
)


# Averages at most: of the best modes, then of those that agree with the poses from
# these, where these are others.
_PASSES = 2
# Of something symmetric at most one likely pair of so many is clear: of cubes none, of
# views of rooms two in five, of scans of objects nearly all.
_SYMMETRIC = 10


class Placement(eqx.Module):
    """Poses of the centred frames, and what they rest on.

    Attributes:
        T_world_i: `(v, d+1, d+1)`, the world being one of each part's own.
        part: `(v,)` int32, the lowest number of the scans that each hangs together
            with, of a scan alone its own.
        edge_weight: `(e,)` trust in each pair.
        mode: `(e,)` int32, which of each pair's modes was averaged.
        status: of the averaging.
        trace: of the averaging.
        world: int32 the part that lies in a world that is known, -1 if there is none.
        misfit: `(v,)` scans that are held in the world where no pair has them.
    """

    T_world_i: Float[Array, "v D D"]
    part: Int[Array, " v"]
    edge_weight: Float[Array, " e"]
    mode: Int[Array, " e"]
    status: StatusArray
    trace: AveragingTrace | None
    world: Int[Array, ""]
    misfit: Bool[Array, " v"]

    @property
    def component(self) -> Int[Array, " v"]:
        """`(v,)` number of each scan's part, the largest first; -1 of scans alone."""
        return part_numbers(self.part, self.world)

    @property
    def placed(self) -> Bool[Array, " v"]:
        """`(v,)` the scans of the largest part."""
        return self.component == 0

    def together(self, i: Int[Array, "*b"], j: Int[Array, "*b"]) -> Bool[Array, "*b"]:
        """Whether scans i and j are of one part."""
        return self.part[i] == self.part[j]


@kept_program
def place(
    motions: RelativeMotions,
    num_scans: int,
    averaging: AbstractAverager | None,
    least: Scalar,
    count: Int[Array, ""] | None = None,
    T_start: Float[Array, "v D D"] | None = None,
    within: Scalar | None = None,
    log_odds: Float[Array, " e"] | None = None,
) -> Placement:
    """Averages the pairs that are likely; the world is the frame of the root.

    Each pair is a mixture of its modes, of which one at a time counts: the best, and
    once poses are known, the one that agrees with them, with its own overlap (a
    max-mixture, as of Olson and Agarwal 2013). A mode that agrees has no rivals any
    more; until then they count against it, unless the scans are of something symmetric,
    where one is as good as another.

    The root is the scan of lowest number in the largest connected set of scans. The
    other sets of two and more are averaged with it, each hung on it by one motion of no
    consequence. Averaging starts from the spanning tree of the likeliest pairs, unless
    a method is given that finds its own start, and stays there where no pairs agree
    with each other.

    A pair joins scans on its own if its log evidence exceeds `least` by the logarithm
    of `most_tries(v)`: each scan is tried against as many others, so the rate of false
    alarms of one trial is divided by them. Others join parts that a second pair, or a
    loop of three parts, confirms. What averaging trusts in the end is about as exact as
    the best pairs. Pairs of small overlap err by more, so others that are `within` some
    distance of the poses may confirm, too.

    Args:
        motions: of pairs.
        num_scans: with those that are padding.
        averaging: None for `Correntropy`.
        least: log evidence of the pairs that count.
        count: how many scans there are, None for all.
        T_start: poses to start from, of parts that hang together by these pairs in a
            frame of each; None to start from the pairs.
        within: how far from the poses a motion may be that joins parts, in radians and
            radii; None for those alone that averaging trusts.
        log_odds: for and against each pair at present poses (`refine.measured`), of all
            that may overlap: together they must speak for joining parts; None if they
            are not known.
    """
    num_tries = most_tries(num_scans if count is None else count)
    strong = least + jnp.log(num_tries.astype(least.dtype))
    best = jnp.zeros(len(motions.pairs), jnp.int32)
    alike = jnp.full(len(best), _is_symmetric(motions, least))
    rule = Joining(least, strong, within, log_odds)
    told = num_scans, averaging, rule, T_start
    if motions.num_modes == 1:
        return _averaged(motions, best, alike, *told)

    def again(state: _Pass) -> _Pass:
        found = _averaged(motions, state.mode, state.agrees, *told)
        mode, agrees = agreeing(motions, found, least)
        differs = jnp.any((mode != state.mode) | (agrees != state.agrees))
        return _Pass(mode, agrees, found, state.number + 1, differs)

    def unfinished(state: _Pass) -> Array:
        return (state.number < _PASSES) & state.differs

    first = _Pass(best, alike, None, jnp.asarray(0), jnp.asarray(True))
    start = jax.eval_shape(again, first)
    start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), start)
    start = start._replace(agrees=alike, differs=jnp.asarray(True))
    found = control.while_loop(unfinished, again, start).found
    assert found is not None
    return found


class _Pass(NamedTuple):
    """An average by some modes, and the modes that agree with it, where any does."""

    mode: Int[Array, " e"]
    agrees: Bool[Array, " e"]
    found: Placement | None
    number: Int[Array, ""]
    differs: Bool[Array, ""]


def _averaged(
    motions: RelativeMotions,
    mode: Int[Array, " e"],
    agrees: Bool[Array, " e"],
    num_scans: int,
    averaging: AbstractAverager | None,
    rule: Joining,
    T_start: Float[Array, "v D D"] | None,
) -> Placement:
    """By one mode of each pair, which others rival unless it agrees with poses."""
    pairs, one = motions.pairs, motions.of_modes(mode, agrees)
    T_i_j, log_evidence = one.T_i_j[:, 0], one.log_evidence[:, 0]
    trusted = prior_weight(one, rule.least)
    label = components(pairs, trusted, num_scans)
    size = part_sizes(label)
    root = jnp.argmax(size).astype(jnp.int32)
    ids = jnp.arange(num_scans, dtype=jnp.int32)
    hung = (label == ids) & (size > 1) & (ids != root)
    # Averaging fixes frame 0: swap the root's number with 0.
    swap = ids.at[root].set(0).at[0].set(root)
    graph = PoseGraph(swap[pairs], T_i_j, trusted, trusted > 0, None, num_scans)
    graph, start = with_hung(graph, hung[swap]), None
    if averaging is None:
        averaging = Correntropy()
        start = _likeliest_tree(graph, log_evidence)
    if T_start is not None:  # each part in the frame that it hangs by
        start = lie.between(T_start[label], T_start)[swap]
    solution = average(graph, averaging, start)
    edge_weight = solution.edge_weight[: len(trusted)] * (trusted > 0)
    T_world_i, placed = solution.T_world_i[swap], solution.placed[swap]
    agreed = placed[pairs].all(axis=1) & joins(edge_weight)
    return Placement(
        T_world_i=T_world_i,
        part=rule.parts(pairs, one, T_world_i, agreed),
        edge_weight=edge_weight,
        mode=mode,
        status=solution.status,
        trace=solution.trace,
        world=jnp.asarray(-1, jnp.int32),
        misfit=jnp.zeros(num_scans, bool),
    )


def _likeliest_tree(
    graph: PoseGraph, log_evidence: Float[Array, " e"]
) -> Float[Array, "v D D"]:
    """Poses along the spanning tree of the likeliest edges, and those that hang parts.

    Not of the largest weights: a wrong pair that shares much outweighs right ones that
    share little, and may take the place between parts that a dozen of them join.
    """
    e = len(log_evidence)
    rank = log_evidence - jnp.min(log_evidence) + 1
    weight = graph.weight.at[:e].set(jnp.where(graph.weight[:e] > 0, rank, 0))
    tree = eqx.tree_at(lambda g: g.weight, graph, weight)
    return average(tree, SpanningTree()).T_world_i


def _is_symmetric(motions: RelativeMotions, least: Scalar) -> Bool[Array, ""]:
    """Whether nearly all pairs that are likely have rivals that are as likely."""
    clear = jnp.sum(motions.log_odds[:, 0] >= least)
    return jnp.sum(motions.log_evidence[:, 0] >= least) >= _SYMMETRIC * clear


def agreeing(
    motions: RelativeMotions, found: Placement, least: Scalar
) -> tuple[Int[Array, " e"], Bool[Array, " e"]]:
    """The first of each pair's modes that agrees with the poses, and if there is one.

    If there is none, the best.
    """
    i, j = motions.pairs.T
    T_i_j = lie.between(found.T_world_i[i], found.T_world_i[j])
    turn, shift = displacement(T_i_j[:, None], motions.T_i_j)
    agrees = (turn < AGREES) & (shift < AGREES) & likely(motions, least)
    agrees = agrees & found.together(i, j)[:, None]
    return jnp.argmax(agrees, axis=1).astype(jnp.int32), jnp.any(agrees, axis=1)
