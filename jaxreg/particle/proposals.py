"""Poses of local features, to be judged beside those that the particles came to.

Where clouds share little, a wrong pose that covers more of the source has less energy
than the right one, and many descents from anywhere end at the wrong one. What is shared
may still look like itself: poses that local features agree on need no descent. They are
refined with the other modes, and the evidence decides among all.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud
from jaxreg.features import propose
from jaxreg.geometry import lie
from jaxreg.particle.modes import distinct_modes
from jaxreg.particle.state import Particles


# Correspondences that agree on a pose: fewer agree by chance, as do those that are a
# smaller share of the most that agree on one.
_LEAST, _SHARE = 4, 0.5


def propose_modes(
    source: PointCloud,
    target: PointCloud,
    spacing: Scalar,
    num: int,
    *,
    apart: Scalar,
    wanted: Bool[Array, ""],
) -> tuple[Float[Array, "q 4 4"], Bool[Array, " q"]]:
    """The distinct poses that most correspondences agree on, and which are in use.

    Args:
        source: in 3D.
        target: likewise.
        spacing: between samples of the coarser cloud.
        num: how many at most.
        apart: poses nearer than this, in radians and radii, are one.
        wanted: whether to look for any.
    """

    def look() -> tuple[Array, Array]:
        agreed = propose(source, target, spacing)
        T, number = agreed.T_target_source, agreed.num_agreeing
        number = number.astype(T.dtype)
        many = number >= jnp.maximum(_SHARE * jnp.max(number), _LEAST)
        energy = jnp.where(many, -number, jnp.inf)
        all_ = Particles.at(T, len(T)).valued(energy)
        rows, mass = distinct_modes(all_, num, angle=apart, distance=apart)
        return T[rows], mass > 0

    def nothing() -> tuple[Array, Array]:
        none = lie.identity(3, source.points.dtype, (num,))
        return none, jnp.zeros(num, bool)

    return control.cond(wanted, look, nothing)
