"""The frames that a pair is registered in: about its centroids, in the target's radius.

Rotation and translation decouple there (PF paper, section 3.1), and neither the unit of
the input nor where it lies matters.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud.point_cloud import centroid, rms_radius
from jaxreg.geometry import lie


#: A cloud this many times larger or smaller than others is in another unit.
OTHER_UNIT = 50.0


class Side(eqx.Module):
    """A cloud as given, cleaned.

    Attributes:
        points, mask: zero and masked where not finite.
        mean: the centroid.
        radius: the root mean square distance from it; one where that is zero.
        enough: whether at least d + 1 distinct points are valid.
    """

    points: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    mean: Float[Array, " d"]
    radius: Scalar
    enough: Bool[Array, ""]

    @classmethod
    def of(cls, cloud: tuple[Array, Array]) -> "Side":
        """Of points and their mask."""
        points, mask = cloud
        mask = mask & jnp.all(jnp.isfinite(points), axis=1)
        points = jnp.where(mask[:, None], points, 0)
        radius = rms_radius(points, mask)
        radius = jnp.where(radius > 0, radius, 1)
        enough = _distinct_enough(points, mask)
        return cls(points, mask, centroid(points, mask), radius, enough)


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


def _distinct_enough(points: Array, mask: Array) -> Array:
    """Whether at least d + 1 distinct points are valid."""
    new, num = mask, jnp.zeros((), jnp.int32)
    for _ in range(points.shape[1] + 1):
        num = num + jnp.any(new)
        new = new & jnp.any(points != points[jnp.argmax(new)][None], axis=1)
    return num > points.shape[1]
