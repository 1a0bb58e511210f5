"""From relative motions to poses: which pairs to trust, and which scans they place."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Scalar, StatusArray
from jaxreg.averaging import AbstractAverager, average
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.trees import components
from jaxreg.multiview.relative import RelativeMotions


# An edge whose residual leaves it less trust than this joins no scans.
_MIN_TRUST = 0.1


class Placement(eqx.Module):
    """Poses of the centred frames, and what they rest on."""

    T_world_i: Float[Array, "v D D"]
    placed: Bool[Array, " v"]
    edge_weight: Float[Array, " e"]
    status: StatusArray
    root: Int[Array, ""]


@eqx.filter_jit
def place(
    motions: RelativeMotions,
    pairs: Int[Array, "e 2"],
    num_scans: int,
    averaging: AbstractAverager | None,
    min_overlap: Scalar,
) -> Placement:
    """Averages the pairs that overlap; the world is the frame of the root.

    The root is the scan of lowest number in the largest connected set of scans, so
    that one scan that fits nowhere does not take the others with it.
    """
    trusted = jnp.where(motions.overlap >= min_overlap, motions.overlap, 0)
    label = components(pairs, trusted, num_scans)
    size = jnp.sum(label[:, None] == label[None, :], axis=1)
    root = jnp.argmax(size).astype(jnp.int32)
    # Averaging fixes frame 0: swap the root's number with 0.
    swap = jnp.arange(num_scans, dtype=jnp.int32).at[root].set(0).at[0].set(root)
    graph = PoseGraph(swap[pairs], motions.T_i_j, trusted, trusted > 0, None, num_scans)
    solution = average(graph, averaging)
    edge_weight = solution.edge_weight * (trusted > 0)
    label = components(
        pairs, jnp.where(edge_weight > _MIN_TRUST, trusted, 0), num_scans
    )
    placed = (label == label[root]) & solution.placed[swap]
    return Placement(
        solution.T_world_i[swap], placed, edge_weight, solution.status, root
    )
