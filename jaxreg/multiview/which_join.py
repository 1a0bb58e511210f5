"""Which pairs count, which agree with poses, and which join scans."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.multiview.join_parts import confirmed_parts, likeliest_parts
from jaxreg.multiview.relative_motions import RelativeMotions


# An edge whose residual leaves it less trust than this joins no scans.
_MIN_TRUST = 0.1
#: A mode agrees with poses within this, in radians and radii: half of what two modes of
#: a pair are apart.
AGREES = 0.15
# Pairs that `register` would not believe may count where others confirm them: those
# whose log evidence is at most so much below.
_CONFIRMABLE = 1.0


def displacement(
    T_a_b: Float[Array, "... D D"], T_other: Float[Array, "... D D"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """How far two motions take a centred scan apart: angle, distance of its centre."""
    R = jnp.einsum("...ij,...kj->...ik", lie.rotation(T_a_b), lie.rotation(T_other))
    shift = lie.translation(T_a_b) - lie.translation(T_other)
    return lie.rotation_angle(R), jnp.sqrt(jnp.sum(shift**2, axis=-1))


def likely(motions: RelativeMotions, least: Scalar) -> Bool[Array, "e m"]:
    """Which modes count where others confirm them."""
    return motions.log_evidence >= least - _CONFIRMABLE


def prior_weight(one: RelativeMotions, least: Scalar) -> Float[Array, " e"]:
    """Of pairs of one mode: overlap times probability, zero of those not likely.

    The larger the overlap, the more accurate the motion.
    """
    weight = one.overlap * jax.nn.sigmoid(one.log_evidence)
    return jnp.where(likely(one, least), weight, 0)[:, 0]


def joins(edge_weight: Float[Array, " e"]) -> Bool[Array, " e"]:
    """Which pairs join scans, by the trust that averaging leaves them."""
    return edge_weight > _MIN_TRUST


def strictly(like: Scalar) -> Scalar:
    """`within` of what averaging trusts and no other pair: an array, no program."""
    return jax.device_put(np.zeros((), like.dtype))


def roughly(like: Scalar) -> Scalar:
    """`within` of pairs that agree, as their modes do."""
    return jax.device_put(np.asarray(AGREES, like.dtype))


class Joining(NamedTuple):
    """Which pairs join scans.

    Attributes:
        least, strong: log evidence of the pairs that count, and that join on their own.
        within, log_odds: see `place`.
    """

    least: Scalar
    strong: Scalar
    within: Scalar | None
    log_odds: Float[Array, " e"] | None

    def parts(
        self,
        pairs: Int[Array, "e 2"],
        one: RelativeMotions,
        T_world_i: Float[Array, "v D D"],
        trusted: Bool[Array, " e"],
    ) -> Int[Array, " v"]:
        """Scans that hang together at these poses; averaging trusts some pairs."""
        log_evidence, num_scans = one.log_evidence[:, 0], T_world_i.shape[0]
        if self.within is not None:
            i, j = pairs.T
            T_i_j = lie.between(T_world_i[i], T_world_i[j])
            apart = jnp.maximum(*displacement(T_i_j, one.T_i_j[:, 0]))
            trusted = trusted | (apart < self.within)
        weight = jnp.where(trusted, prior_weight(one, self.least), 0)
        joining = pairs, weight, num_scans, log_evidence >= self.strong
        if self.log_odds is None:
            return confirmed_parts(*joining)
        return likeliest_parts(*joining, self.log_odds)
