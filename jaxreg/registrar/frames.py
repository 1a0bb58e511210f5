"""Frames of the input of `register`, and those that its methods work in."""

import equinox as eqx
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie


class Frames(eqx.Module):
    """Between the frames of the input and those about the centroids of the clouds.

    Attributes:
        source_mean, target_mean: `(d,)` the centroids, in the unit of the input.
        radius: the target's root mean square radius: the unit of the latter.
    """

    source_mean: Float[Array, " d"]
    target_mean: Float[Array, " d"]
    radius: Scalar

    @property
    def d(self) -> int:
        """Dimension of the points."""
        return self.source_mean.shape[0]

    def enter(self, T_target_source: Motion) -> Motion:
        """A pose between the frames of the input in those of `solve`."""
        R = lie.rotation(T_target_source).astype(self.radius.dtype)
        t = lie.translation(T_target_source).astype(self.radius.dtype)
        shift = R @ self.source_mean + t - self.target_mean
        return lie.compose(R, shift / self.radius)

    def leave(self, T_target_source: Motion) -> Motion:
        """A pose between the frames of `solve` in those of the input."""
        R = lie.rotation(T_target_source)
        t = self.radius * lie.translation(T_target_source) + self.target_mean
        return lie.compose(R, t - R @ self.source_mean)
