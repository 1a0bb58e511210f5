"""How far each pair's own motion is trusted, by the final poses."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import displacement


def pair_trust(
    scans: PreparedScans,
    motions: RelativeMotions,
    placement: Placement,
    weight: Float[Array, " e"],
) -> Float[Array, " e"]:
    """Agreement of one motion of each pair with the poses; the radius is one.

    Args:
        scans: prepared scans.
        motions: m = 1, between the centred frames.
        placement: the poses.
        weight: above 0 for the pairs that count.
    """
    i, j = motions.pairs[:, 0], motions.pairs[:, 1]
    T_world_i = placement.T_world_i
    T_i_j = lie.between(T_world_i[i], T_world_i[j])
    turn, shift = displacement(T_i_j, motions.T_i_j[:, 0])
    sq = turn**2 + shift**2
    spacing = jnp.maximum(scans.spacing[i], scans.spacing[j])
    trust = jnp.exp(-sq / (2 * jnp.maximum(spacing, 1e-6) ** 2))
    return jnp.where((weight > 0) & placement.together(i, j), trust, 0)
