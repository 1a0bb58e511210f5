"""`PointCloud`: points with normals and a mask."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import spread_rows
from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Mask, Points
from jaxreg.cloud.described import Described
from jaxreg.cloud.normals import Windows
from jaxreg.cloud.range_image import RangeImage
from jaxreg.neighbours import BruteForce, Neighbours


class PointCloud(BriefModule):
    """Points of which `mask` are valid, with unoriented unit normals.

    Attributes:
        points: `(n, d)`.
        normals: `(n, d)` unit normals of either sign; zero where undefined.
        mask: `(n,)` True for valid points.
        seen: what the scanner saw of them, where its viewpoint is known.
        spacing: `(n,)` mean distance to the nearest other points, two on a curve and
            four on a surface, where it is known (`with_spacing`).
        fine: the same surface with more points, for the last digits of a pose; None if
            there are no more.
        judged: the same surface with as many points as poses are judged by; None if
            these are as many.
        described: some of the points with local features, where they are known.
        window: what the normals were taken from, until they are `followed`.
    """

    points: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    seen: RangeImage | None = None
    spacing: Float[Array, " n"] | None = None
    fine: "PointCloud | None" = None
    judged: "PointCloud | None" = None
    described: Described | None = None
    window: Windows | None = None

    def followed(self) -> "PointCloud":
        """With normals that have the derivatives of the points that they are of."""
        fine = None if self.fine is None else self.fine.followed()
        if self.window is None:
            return replace(self, fine=fine)
        normals = self.window.follow(self.normals)
        return replace(self, normals=normals, fine=fine, window=None)

    def padded(self, num: int) -> "PointCloud":
        """With masked rows behind it, `num` in all."""
        rows = (0, num - self.mask.shape[0])
        return replace(
            self,
            points=jnp.pad(self.points, (rows, (0, 0))),
            normals=jnp.pad(self.normals, (rows, (0, 0))),
            mask=jnp.pad(self.mask, rows),
            spacing=None if self.spacing is None else jnp.pad(self.spacing, rows),
        )

    def first(self, num: int) -> "PointCloud":
        """The first `num` rows, or all."""
        return self.of_rows(slice(num))

    def of_rows(self, rows: Int[Array, " r"] | slice) -> "PointCloud":
        """Some of the rows, which keep the spacing that they have among all."""
        return replace(
            self,
            points=self.points[rows],
            normals=self.normals[rows],
            mask=self.mask[rows],
            spacing=None if self.spacing is None else self.spacing[rows],
        )

    @property
    def finest(self) -> "PointCloud":
        """With the most points there are."""
        return self if self.fine is None else self.fine

    @property
    def as_judged(self) -> "PointCloud":
        """With as many points as poses are judged by."""
        return self if self.judged is None else self.judged

    def spread(self, num: int) -> "PointCloud":
        """At most so many valid rows, spread over the array; no spacing is known."""
        if len(self.mask) <= num:
            return self
        rows, use = spread_rows(self.mask, num)
        some = self.of_rows(rows)
        return PointCloud(some.points, some.normals, use, self.seen)

    def seen_from(self, viewpoint: Float[Array, " d"]) -> "PointCloud":
        """With what was seen of it from there; of NaN nothing is known."""
        seen = RangeImage.of(self.points, self.mask, viewpoint)
        judged = None if self.judged is None else self.judged.seen_from(viewpoint)
        return replace(self, seen=seen, judged=judged)

    def with_spacing(self) -> "PointCloud":
        """With the spacing around each point, by comparing all pairs if not known."""
        if self.spacing is not None:
            return self
        num = 1 + num_around(self.points.shape[1])
        found = BruteForce.build(self.points, self.mask).query(self.points, num)
        spacing = spacing_around(found, self.mask)
        return replace(self, spacing=spacing)


def num_around(d: int) -> int:
    """Neighbours on a grid of a curve or a surface in d dimensions."""
    return 2 * (d - 1)


def spacing_around(found: Neighbours, mask: Mask) -> Float[Array, " n"]:
    """Mean distance to the nearest others, of neighbours with the point itself first.

    Zero of points that are not valid or have none. Gradients: of the distances.
    """
    sq = found.sq_distance[:, 1:]
    valid = found.valid[:, 1:] & mask[:, None] & (sq > 0)
    total = jnp.sum(jnp.where(valid, jnp.sqrt(jnp.where(valid, sq, 1)), 0), axis=1)
    valid = found.valid[:, 1:] & mask[:, None]
    return total / jnp.maximum(jnp.sum(valid, axis=1), 1)


def levelled(a: PointCloud, b: PointCloud) -> tuple[PointCloud, PointCloud]:
    """Both with the rows of the larger: clouds of one size share compiled code."""
    num = max(len(a.mask), len(b.mask))
    return a.padded(num), b.padded(num)


def centroid(points: Points, mask: Mask) -> Float[Array, " d"]:
    """The mean of the valid points (zero where there are none)."""
    weight = mask.astype(points.dtype)
    first = points[jnp.argmax(mask)]  # sums of differences: safe far from the origin
    mean = jnp.sum(weight[:, None] * (points - first[None]), axis=0)
    return first + mean / jnp.maximum(jnp.sum(weight), 1)


def rms_radius(points: Points, mask: Mask) -> Float[Array, ""]:
    """Root mean square distance of the valid points from their centroid."""
    offset = jnp.where(mask[:, None], points - centroid(points, mask)[None], 0)
    num = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    mean = jnp.sum(offset**2) / num
    # The root of zero has no finite slope.
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1)), 0)
