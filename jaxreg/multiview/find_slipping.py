"""Which scans the surfaces hold in place, and which can slip along the others.

Pairs whose surfaces hold each other make bodies. What one pair leaves free another may
hold, so two bodies that are not held by one pair may be by all of theirs together, and
then are one; and so on.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.graph.trees import components
from jaxreg.matching import Grip
from jaxreg.multiview.place import Placement, in_main_body
from jaxreg.multiview.prepare import PreparedScans


@kept_program
def slipping(
    scans: PreparedScans, placement: Placement, least: Scalar, pairs: Int[Array, "p 2"]
) -> Bool[Array, " v"]:
    """`(v,)` scans that can move along the main body of their part.

    Args:
        scans: prepared scans.
        placement: their final poses.
        least: log evidence of the pairs that count.
        pairs: those that may overlap (`near_pairs`).
    """
    body = _bodies(pairs, _grips(scans, placement, pairs, least), scans.num_scans)
    return ~in_main_body(body, placement.part)


def _grips(
    scans: PreparedScans,
    placement: Placement,
    pairs: Int[Array, "e 2"],
    least: Scalar,
) -> Grip:
    """Of every pair that is likely, in the world's frame; nothing of the others."""
    T_world_i = placement.T_world_i

    def one(pair: Array) -> Grip:
        i, j = pair
        T_i_j = lie.between(T_world_i[i], T_world_i[j])
        witness = scans.witness(i, j)
        found = witness.of_pose(T_i_j)
        use = (found.log_evidence >= least) & placement.together(i, j) & (i != j)
        grip = jax.tree.map(lambda x: jnp.where(use, x, 0), found.grip)
        return grip.seen_from(T_world_i[i])

    return lax.map(one, pairs)


def _bodies(pairs: Int[Array, "e 2"], grips: Grip, num_scans: int) -> Int[Array, " v"]:
    """The lowest number of the scans of each scan's body."""

    def between(body: Int[Array, " v"]) -> Bool[Array, " e"]:
        a, b = body[pairs[:, 0]], body[pairs[:, 1]]
        row = jnp.minimum(a, b) * num_scans + jnp.maximum(a, b)
        sums = jax.tree.map(lambda x: jax.ops.segment_sum(x, row, num_scans**2), grips)
        return sums.holds[row] | (a == b)

    def joined(state: tuple[Array, Array]) -> tuple[Array, Array]:
        body, _ = state
        new = components(pairs, between(body).astype(grips.count.dtype), num_scans)
        return new, jnp.any(new != body)

    start = jnp.arange(num_scans, dtype=jnp.int32)
    return control.while_loop(lambda s: s[1], joined, (start, jnp.asarray(True)))[0]
