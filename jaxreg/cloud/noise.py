"""Points of noise that fill the box of a scan, told from its surfaces by their density.

Surfaces and lines leave most of a scan's bounding box empty; noise without a surface
fills it. So empty cells bound its density: cells without any of `b` points that are
spread at random over `m` cells are a share exp(-b / m). From the bound follows how many
points of noise a window of three cells holds, and a point with hardly more than these
around it counts as one of them. Sums over cells, no search, no length or share given.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxreg._core import control
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.geometry.boxes import bounding_box


# Clouds of fewer points are thin themselves, and hardly merged by thinning.
_FEW = 2000
# Surfaces of real scans leave as many cells empty as 40 to 160 points of noise.
_LEAST = 300
# Sizes of cells that are counted, each so many times the last; the bound is the least
# of those at which cells enough are empty, and cells enough there are.
_SIZES, _STEP, _EMPTY, _FEWEST_CELLS = 7, 1.5, 0.05, 60
# Flat boxes are counted as so many times as thick as long: a wall fills its own.
_FLAT = 0.1
# Windows hold some points of noise; at most so many cells are counted.
_NOISE, _WINDOW, _MOST_CELLS = 27 / 8, 3, 1 << 21
# A window of noise alone holds more than so many deviations above its mean by chance
# once in a thousand times.
_DEVIATIONS = 3.5
# Where so few points would be left, there is no surface that stands out.
_LEFT = 0.2


def without_noise(points: Points, mask: Mask) -> Mask:
    """Which valid points are not noise that fills the bounding box.

    All of a cloud without such noise, of one of less than 2,000 points, and of one in
    which nothing stands out. Of scans with 10 to 70 % of noise and 8,000 points or more
    it keeps 2 to 27 % of the noise, less of more, and 97 % or more of the rest, in the
    sparse parts of lidar scans 90 %.

    Args:
        points: `(n, d)`; large gaps in density, as far strays make, hide noise.
        mask: `(n,)` True for valid points.

    Gradients: none.
    """
    n = points.shape[0]
    if n < _FEW:
        return mask
    points = lax.stop_gradient(points)
    low, high = bounding_box(points, mask)
    side = jnp.maximum(high - low, _FLAT * jnp.max(high - low))
    places = (points - low) / jnp.where(side > 0, side, 1)
    amount = _most_noise(places, mask)

    def denser(places: Points) -> Mask:
        keep = mask & _denser_than(amount, places, mask)
        enough = jnp.sum(keep) >= _LEFT * jnp.sum(mask)
        return jnp.where(enough, keep, mask)

    return control.cond(amount >= _LEAST, denser, lambda _: mask, places)


def _most_noise(places: Points, mask: Mask) -> Scalar:
    """A bound on the number of points that are spread at random over the unit cube."""
    n, d = places.shape
    num = jnp.minimum(jnp.sum(mask), _MOST_CELLS).astype(places.dtype)
    finest = num ** (1 / d)

    def bound(level: Int[Array, ""]) -> Scalar:
        m = jnp.floor(finest / _STEP ** level.astype(places.dtype)).astype(jnp.int32)
        cell = _cells(places, m)
        row = jnp.zeros_like(cell[0])
        for x in cell:
            row = m * row + x
        row = jnp.where(mask, row, n)
        filled = jnp.zeros(n, bool).at[row].set(True, mode="drop")
        cells = (m**d).astype(places.dtype)
        empty = 1 - jnp.sum(filled) / jnp.maximum(cells, 1)
        use = (empty >= _EMPTY) & (cells >= _FEWEST_CELLS)
        return jnp.where(use, -jnp.log(jnp.maximum(empty, _EMPTY)) * cells, jnp.inf)

    bounds = lax.map(bound, jnp.arange(_SIZES, dtype=jnp.int32))
    least = jnp.min(bounds)
    return jnp.where(jnp.isfinite(least), least, 0)


def _denser_than(amount: Scalar, places: Points, mask: Mask) -> Mask:
    """Points with more around them than so many in the unit cube make likely."""
    n, d = places.shape
    most = int(min(n * _WINDOW**d / _NOISE, _MOST_CELLS) ** (1 / d))
    wanted = (amount * _WINDOW**d / _NOISE) ** (1 / d)
    m = jnp.clip(wanted, 1, most).astype(jnp.int32)
    cell = tuple(_cells(places, m) + 1)  # a rim of empty cells
    count = jnp.zeros((most + 2,) * d, jnp.int32)
    count = count.at[cell].add(mask.astype(jnp.int32))
    for axis in range(d):
        count = _sum_of_three(count, axis)
    noise = amount * (_WINDOW / m.astype(places.dtype)) ** d
    return count[cell] >= 1 + noise + _DEVIATIONS * jnp.sqrt(noise)


def _cells(places: Points, m: Int[Array, ""]) -> Int[Array, "d n"]:
    """Of m along each axis."""
    return jnp.clip((places * m).astype(jnp.int32), 0, m - 1).T


def _sum_of_three(count: Int[Array, "*m"], axis: int) -> Int[Array, "*m"]:
    """With both neighbours along an axis, of which the first and last are empty."""
    return count + jnp.roll(count, 1, axis) + jnp.roll(count, -1, axis)
