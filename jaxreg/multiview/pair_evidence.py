"""What the surfaces of placed scans say of their poses, pair by pair.

Refinement asks for it twice and slipping once, at other poses each time: one program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxreg._core import control
from jaxreg._core.programs import kept_program
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.geometry import lie
from jaxreg.matching import NO_EVIDENCE, Evidence
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans


@kept_program
def pair_evidence(
    scans: PreparedScans, placement: Placement, pairs: Int[Array, "b 2"]
) -> Evidence:
    """Of scan j on scan i; `NO_EVIDENCE` of pairs that do not hang together.

    Args:
        scans: prepared scans.
        placement: their poses.
        pairs: those of a scan and itself are padding and have none.
    """
    T_world_i = placement.T_world_i

    def told(pair: Array) -> Evidence:
        i, j = pair
        T_i_j = lie.between(T_world_i[i], T_world_i[j])
        return scans.witness(i, j).of_pose(T_i_j)

    def nothing(pair: Array) -> Evidence:
        shapes = jax.eval_shape(told, pair)
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        none = jnp.full_like(zero.log_evidence, NO_EVIDENCE)
        return eqx.tree_at(lambda e: (e.log_evidence, e.contact), zero, (none, none))

    def one(pair: Array) -> Evidence:
        i, j = pair
        return control.cond(placement.together(i, j) & (i != j), told, nothing, pair)

    return map_side_by_side(one, pairs, scans.num_rows)
