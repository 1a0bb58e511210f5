"""From relative motions to poses: which pairs to trust, and which scans they place."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.compile import compiled
from jaxreg._core.typing import Scalar, StatusArray
from jaxreg.averaging import (
    AbstractAverager,
    Correntropy,
    SpanningTree,
    average,
)
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import components
from jaxreg.multiview.relative import RelativeMotions


# An edge whose residual leaves it less trust than this joins no scans.
_MIN_TRUST = 0.1
# Pairs of overlap above this many times the least one join scans on their own; weaker
# ones must be confirmed by a second pair between the same parts.
_STRONG = 2.0


class Placement(eqx.Module):
    """Poses of the centred frames, and what they rest on.

    Attributes:
        T_world_i: `(v, d+1, d+1)`.
        placed: `(v,)` the largest part.
        part: `(v,)` int32, the same for scans that hang together.
        edge_weight: `(e,)` trust in each pair.
        status: of the averaging.
    """

    T_world_i: Float[Array, "v D D"]
    placed: Bool[Array, " v"]
    part: Int[Array, " v"]
    edge_weight: Float[Array, " e"]
    status: StatusArray


@compiled
def place(
    motions: RelativeMotions,
    num_scans: int,
    averaging: AbstractAverager | None,
    min_overlap: Scalar,
) -> Placement:
    """Averages the pairs that overlap; the world is the frame of the root.

    The root is the scan of lowest number in the largest connected set of scans, so
    that one scan that fits nowhere does not take the others with it. Overlap is
    evidence of its own, so averaging starts from the spanning tree of largest overlap.
    """
    if averaging is None:
        averaging = Correntropy(initialiser=SpanningTree())
    pairs = motions.pairs
    trusted = jnp.where(motions.overlap >= min_overlap, motions.overlap, 0)
    label = components(pairs, trusted, num_scans)
    size = jnp.sum(label[:, None] == label[None, :], axis=1)
    root = jnp.argmax(size).astype(jnp.int32)
    # Averaging fixes frame 0: swap the root's number with 0.
    swap = jnp.arange(num_scans, dtype=jnp.int32).at[root].set(0).at[0].set(root)
    graph = PoseGraph(swap[pairs], motions.T_i_j, trusted, trusted > 0, None, num_scans)
    solution = average(graph, averaging)
    edge_weight = solution.edge_weight * (trusted > 0)
    agreed = jnp.where(believed(edge_weight), trusted, 0)
    label = _confirmed_components(pairs, agreed, num_scans, _STRONG * min_overlap)
    # Averaging made the largest set of candidates the world; the largest confirmed
    # part of it is what is placed.
    size = jnp.sum(label[:, None] == label[None, :], axis=1)
    size = jnp.where(solution.placed[swap], size, 0)
    placed = label == label[jnp.argmax(size)]
    return Placement(
        solution.T_world_i[swap], placed, label, edge_weight, solution.status
    )


def believed(edge_weight: Float[Array, " e"]) -> Bool[Array, " e"]:
    """Which pairs join scans, by the trust that averaging leaves them."""
    return edge_weight > _MIN_TRUST


def _confirmed_components(
    pairs: Int[Array, "e 2"],
    overlap: Float[Array, " e"],
    num_scans: int,
    strong: Scalar,
) -> Int[Array, " v"]:
    """Components joined by strong pairs, or by two or more weak ones that agree."""
    core = components(pairs, jnp.where(overlap >= strong, overlap, 0), num_scans)
    i, j = core[pairs[:, 0]], core[pairs[:, 1]]
    low, high = jnp.minimum(i, j), jnp.maximum(i, j)
    count = jnp.zeros((num_scans, num_scans), jnp.int32)
    count = count.at[low, high].add((overlap > 0).astype(jnp.int32))
    confirmed = (low == high) | (count[low, high] >= 2)
    return components(pairs, jnp.where(confirmed, overlap, 0), num_scans)
