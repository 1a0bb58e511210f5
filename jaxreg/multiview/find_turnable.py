"""Which scans could as well lie otherwise: on symmetric objects, by a finite turn.

A pair of which another mode is as likely as the best settles nothing. Pairs that
are settled make bodies; scans that only the others join to them may be elsewhere.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxreg._core.programs import kept_program
from jaxreg.graph.trees import components
from jaxreg.multiview.parts import in_main_body
from jaxreg.multiview.place import Placement
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import joins


# Modes that a symmetry makes equal differ in log evidence by 0.25 at most, in 108 pairs
# of cubes, boxes, prisms and tori of 500 to 4,000 points, with noise or not.
_AS_LIKELY = 0.5


@kept_program
def turnable(motions: RelativeMotions, placement: Placement) -> Bool[Array, " v"]:
    """`(v,)` scans that no settled pairs join to the main body of their part.

    Args:
        motions: modes of the pairs.
        placement: what was made of them.
    """
    best = motions.log_evidence[:, :1]
    rival = jnp.any(motions.log_evidence[:, 1:] > best - _AS_LIKELY, axis=1)
    settled = joins(placement.edge_weight) & ~rival
    part = placement.part
    body = components(motions.pairs, settled.astype(best.dtype), part.shape[0])
    return ~in_main_body(body, part)
