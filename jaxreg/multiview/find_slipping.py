"""Which scans the surfaces hold in place, and which can slip along the others.

Pairs whose surfaces hold each other make bodies. What one pair leaves free another may
hold, so two bodies that are not held by one pair may be by all of theirs together, and
then are one; and so on.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.graph.joined import joined
from jaxreg.graph.trees import components
from jaxreg.matching import Evidence, Grip
from jaxreg.multiview.in_blocks import in_blocks
from jaxreg.multiview.pair_evidence import pair_evidence
from jaxreg.multiview.parts import in_main_body
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans


def slipping(
    scans: PreparedScans,
    placement: Placement,
    least: Scalar,
    pairs: Int[Array, "p 2"],
    held: Bool[Array, " v"] | None = None,
) -> Bool[Array, " v"]:
    """`(v,)` scans that can move along the main body of their part.

    Args:
        scans: prepared scans.
        placement: their final poses.
        least: log evidence of the surfaces of pairs that count (`Evidence.contact`).
        pairs: those that may overlap (`near_pairs`).
        held: scans that are one body from the start, None if there are none.
    """

    def run(block: Array) -> Grip:
        told = pair_evidence(scans, placement, block)
        return _grips(placement, block, told, least)

    grips = in_blocks(run, pairs, (scans, placement))
    body = jax.device_put(np.arange(scans.num_scans, dtype=np.int32))
    if held is not None:
        body = jnp.where(held, jnp.argmax(held).astype(jnp.int32), body)
    return _apart(pairs, grips, placement.part, body)


@kept_program
def _grips(
    placement: Placement, pairs: Int[Array, "b 2"], told: Evidence, least: Scalar
) -> Grip:
    """Of every pair that is likely, in the world's frame; nothing of the others."""

    def where_likely(x: Array) -> Array:
        use = jnp.expand_dims(told.contact >= least, tuple(range(1, x.ndim)))
        return jnp.where(use, x, 0)

    grips = jax.tree.map(where_likely, told.grip)
    return grips.seen_from(placement.T_world_i[pairs[:, 0]])


@kept_program
def _apart(
    pairs: Int[Array, "p 2"],
    grips: Grip,
    part: Int[Array, " v"],
    body: Int[Array, " v"],
) -> Bool[Array, " v"]:
    """Bodies at the start are told by the lowest numbers of their scans."""
    body = _bodies(body[pairs], grips, part.shape[0])[body]
    return ~in_main_body(body, part)


def _bodies(pairs: Int[Array, "e 2"], grips: Grip, num_scans: int) -> Int[Array, " v"]:
    """The lowest number of the scans of each scan's body."""

    def between(body: Int[Array, " v"]) -> Bool[Array, " e"]:
        ends = body[pairs]
        row = joined(ends).row
        sums = jax.tree.map(lambda x: jax.ops.segment_sum(x, row, len(row)), grips)
        return sums.holds[row] | (ends[:, 0] == ends[:, 1])

    def merged(state: tuple[Array, Array]) -> tuple[Array, Array]:
        body, _ = state
        new = components(pairs, between(body).astype(grips.count.dtype), num_scans)
        return new, jnp.any(new != body)

    start = jnp.arange(num_scans, dtype=jnp.int32)
    return control.while_loop(lambda s: s[1], merged, (start, jnp.asarray(True)))[0]
