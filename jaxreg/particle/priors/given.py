"""Particles of the caller's own."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.checks import as_float_array
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.particle.priors.base import AbstractPrior
from jaxreg.registrar import Frames


def _poses(T_target_source: object) -> Array:
    T = as_float_array(T_target_source, "T_target_source")
    if T.ndim != 3 or T.shape[1] not in (3, 4) or T.shape[1] != T.shape[2]:
        raise ValueError(
            "GivenParticles: T_target_source: wanted shape (p, 3, 3) or (p, 4, 4), "
            f"found {T.shape}."
        )
    return T


class GivenParticles(AbstractPrior):
    """x_0^i, i = 1 .. N, as they are: the same start for several methods.

    The PF paper's section 5.2.1 compares dynamics so. `init` is not looked at.

    Attributes:
        T_target_source: `(p, d+1, d+1)` poses between the frames of `register`'s
            input; as many as the method starts with.

    Raises: ValueError, TypeError for anything that is not a stack of poses, or not as
        many as the method starts with, or of another dimension than the points.
    """

    T_target_source: Float[Array, "p D D"] = eqx.field(converter=_poses)

    def check_number(self, wanted: int, name: str) -> None:
        """Requires as many poses as the method, in its field `name`, starts with."""
        found = self.T_target_source.shape[0]
        if found != wanted:
            raise ValueError(
                f"GivenParticles: T_target_source: wanted {name} = {wanted} poses, "
                f"found {found}."
            )

    def draw(
        self, key: Key, num: int, d: int, init: Motion | None, dtype: Any
    ) -> Float[Array, "p D D"]:
        """The poses."""
        self._check_dimension(d)
        self.check_number(num, "num")
        return self.T_target_source.astype(dtype)

    def in_frames(self, frames: Frames) -> "GivenParticles":
        """With each pose between the centroids."""
        self._check_dimension(frames.d)
        return GivenParticles(jax.vmap(frames.enter)(self.T_target_source))

    def log_density(self, T_target_source: Motion) -> Scalar:
        """Zero: it only says where to begin."""
        return jnp.zeros((), T_target_source.dtype)

    def _check_dimension(self, d: int) -> None:
        if self.T_target_source.shape[-1] != d + 1:
            raise ValueError(
                f"GivenParticles: T_target_source: wanted shape (p, {d + 1}, {d + 1}) "
                f"for points of dimension {d}, found {self.T_target_source.shape}."
            )
