"""What a scan saw from its viewpoint: the range of the nearest surface along rays.

Directions from the viewpoint are mapped to a plane by Lambert's azimuthal projection
about their mean, which keeps areas and holds the whole sphere in a disc, so that the
cells of a grid over the part that the scan fills are alike for a narrow camera and for
a scanner that turns. In 2D the map is the angle.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxreg._core.typing import Mask, Points


# Of a cell and its neighbours so many must hold points, or it is not known what lies
# behind: a scan has holes, and its outline is ragged.
_SHARE_SEEN = 0.7
# Points of a full cloud for each cell of the square around it.
_POINTS_PER_CELL = 1.5
# The grid is so much larger than the part that the scan fills.
_MARGIN = 1.001


class RangeImage(eqx.Module):
    """Ranges around a viewpoint, in cells of equal area (of equal angle in 2D).

    Attributes:
        viewpoint: `(d,)` in the frame of the points.
        axes: `(d, d)` rows; the first is the mean direction of the points.
        cells_per_unit: cells of the grid in a unit of the projection.
        across: cells along an axis that are in use: as few as there are points for, of
            a cloud with padding.
        nearest: `(g, ..)` of d - 1 axes: the least range in a cell and its neighbours;
            -inf where that is not known.
    """

    viewpoint: Float[Array, "*b d"]
    axes: Float[Array, "..."]
    cells_per_unit: Float[Array, "*b"]
    across: Float[Array, "*b"]
    nearest: Float[Array, "..."]

    @classmethod
    def of(cls, points: Points, mask: Mask, viewpoint: Float[Array, " d"]):
        """The image of a cloud; nothing is known if the viewpoint is not finite."""
        d = points.shape[1]
        known = jnp.all(jnp.isfinite(viewpoint))
        viewpoint = jnp.where(known, viewpoint, 0)
        ray = jnp.where(mask[:, None], points - viewpoint, 0)
        length = jnp.linalg.norm(ray, axis=1)
        mask = mask & (length > 0) & known
        unit = ray / jnp.where(length > 0, length, 1)[:, None]
        axes = _axes_along(jnp.sum(unit, axis=0))
        place = _projected(axes, unit)
        extent = jnp.max(jnp.where(mask[:, None], jnp.abs(place), 0))
        full, power = len(mask) / _POINTS_PER_CELL, 1 / (d - 1)
        num = max(round(full**power), 3)
        across = jnp.round((full * jnp.mean(mask)) ** power)
        across = jnp.clip(across, 3, num).astype(points.dtype)
        image = cls(
            viewpoint,
            axes,
            across / (_MARGIN * 2 * jnp.maximum(extent, 1e-6)),
            across,
            jnp.full((num,) * (d - 1), jnp.inf, points.dtype),
        )
        cell = image._cells(place)
        cell = tuple(jnp.where(mask, c, num) for c in cell)
        nearest = image.nearest.at[cell].min(length, mode="drop")
        return eqx.tree_at(lambda i: i.nearest, image, _around(nearest))

    @property
    def known(self) -> Bool[Array, "*b"]:
        """Whether anything is."""
        axes = tuple(range(self.viewpoint.ndim - 1, self.nearest.ndim))
        return jnp.any(jnp.isfinite(self.nearest), axis=axes)

    def depth_before(self, points: Float[Array, "d n"]) -> Float[Array, " n"]:
        """How far points lie before the surface along their rays; -inf if not known.

        Args:
            points: columns, in the frame of the image's points.
        """
        ray = (points - self.viewpoint[:, None]).T
        length = jnp.linalg.norm(ray, axis=1)
        unit = ray / jnp.where(length > 0, length, 1)[:, None]
        cell = self._cells(_projected(self.axes, unit))
        found = self.nearest.at[cell].get(mode="fill", fill_value=-jnp.inf)
        return found - length

    def _cells(self, place: Float[Array, "n e"]) -> tuple[Array, ...]:
        num = self.nearest.shape[-1]
        cell = jnp.floor(place * self.cells_per_unit + self.across / 2)
        # Outside is beyond the last: a negative number would count from the end.
        outside = (cell < 0) | (cell >= self.across)
        return tuple(jnp.where(outside, num, cell.astype(jnp.int32)).T)


def _axes_along(direction: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Orthonormal rows, the first along a direction; any if that is zero."""
    d = len(direction)
    length = jnp.linalg.norm(direction)
    first = jnp.eye(d, dtype=direction.dtype)[0]
    first = jnp.where(length > 0, direction / jnp.where(length > 0, length, 1), first)
    if d == 2:
        return jnp.stack([first, jnp.stack([-first[1], first[0]])])
    other = jnp.eye(d, dtype=direction.dtype)[jnp.argmin(jnp.abs(first))]
    second = jnp.cross(first, other)
    second = second / jnp.linalg.norm(second)
    return jnp.stack([first, second, jnp.cross(first, second)])


def _projected(
    axes: Float[Array, "d d"], unit: Float[Array, "n d"]
) -> Float[Array, "n e"]:
    """Places of unit directions on the map, d - 1 coordinates."""
    along = unit @ axes.T
    if len(axes) == 2:
        return jnp.arctan2(along[:, 1:], along[:, :1])
    stretch = jnp.sqrt(2 / jnp.maximum(1 + along[:, :1], 1e-6))
    return stretch * along[:, 1:]


def _around(nearest: Array) -> Array:
    """The least of each cell and its neighbours where enough of them are seen."""
    rank = nearest.ndim
    window, ones = (3,) * rank, (1,) * rank
    least = lax.reduce_window(nearest, jnp.inf, lax.min, window, ones, "SAME")
    seen = jnp.isfinite(nearest).astype(nearest.dtype)
    count = lax.reduce_window(seen, 0.0, lax.add, window, ones, "SAME")
    return jnp.where(count >= _SHARE_SEEN * 3**rank, least, -jnp.inf)
