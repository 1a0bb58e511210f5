"""Bounded energy."""

from typing import ClassVar

import jax.numpy as jnp

from jaxreg._core.typing import Scalar
from jaxreg.local import Match
from jaxreg.particle.energies.base import AbstractEnergy


class BoundedEnergy(AbstractEnergy):
    """1 - mean of agreement / (1 + r^2 / width^2), in [0, 1].

    Bounded, as partial overlap needs it: points of the source without a counterpart
    cost one, however far away they are. Agreement is the squared cosine between the
    normals, one where there are none.
    """

    resolution: ClassVar[float] = 4.0

    def __call__(self, found: Match, width: Scalar) -> Scalar:
        """The share of the source that has no counterpart, softly."""
        support = found.agreement / (1 + found.sq_residual / width**2)
        total = jnp.maximum(jnp.sum(found.mask), 1).astype(support.dtype)
        return 1 - jnp.sum(support) / total
