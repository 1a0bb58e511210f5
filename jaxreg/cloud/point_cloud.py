"""`PointCloud`: points with normals and a mask."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Mask, Points
from jaxreg.cloud.range_image import RangeImage


class PointCloud(BriefModule):
    """Points of which `mask` are valid, with unoriented unit normals.

    Attributes:
        points: `(n, d)`.
        normals: `(n, d)` unit normals of either sign; zero where undefined.
        mask: `(n,)` True for valid points.
        seen: what the scanner saw of them, where its viewpoint is known.
    """

    points: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    seen: RangeImage | None = None

    def padded(self, num: int) -> "PointCloud":
        """With masked rows behind it, `num` in all."""
        rows = (0, num - self.mask.shape[0])
        return PointCloud(
            jnp.pad(self.points, (rows, (0, 0))),
            jnp.pad(self.normals, (rows, (0, 0))),
            jnp.pad(self.mask, rows),
            self.seen,
        )

    def first(self, num: int) -> "PointCloud":
        """The first `num` rows, or all."""
        points, normals = self.points[:num], self.normals[:num]
        return PointCloud(points, normals, self.mask[:num], self.seen)

    def seen_from(self, viewpoint: Float[Array, " d"]) -> "PointCloud":
        """With what was seen of it from there; of NaN nothing is known."""
        seen = RangeImage.of(self.points, self.mask, viewpoint)
        return PointCloud(self.points, self.normals, self.mask, seen)


def levelled(a: PointCloud, b: PointCloud) -> tuple[PointCloud, PointCloud]:
    """Both with the rows of the larger: clouds of one size share compiled code."""
    num = max(len(a.mask), len(b.mask))
    return a.padded(num), b.padded(num)


def centroid(points: Points, mask: Mask) -> Float[Array, " d"]:
    """The mean of the valid points (zero where there are none)."""
    weight = mask.astype(points.dtype)
    first = points[jnp.argmax(mask)]  # sums of differences: safe far from the origin
    mean = jnp.sum(weight[:, None] * (points - first), axis=0)
    return first + mean / jnp.maximum(jnp.sum(weight), 1)


def rms_radius(points: Points, mask: Mask) -> Float[Array, ""]:
    """Root mean square distance of the valid points from their centroid."""
    offset = jnp.where(mask[:, None], points - centroid(points, mask), 0)
    num = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    return jnp.sqrt(jnp.sum(offset**2) / num)
