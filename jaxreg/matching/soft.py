"""Soft matches: a mean of the nearest few target points in place of the closest one.

The closest point jumps from sample to sample as a pose moves, and with it the answer of
a registration: its derivative, exact while the matches are held, says little of a
change that exchanges some. A mean whose weights fall off with the distance moves
smoothly.

Reference: Granger, Pennec: Multi-scale EM-ICP, 2002, whose weights these are, over the
surroundings of the closest point alone.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import check_counts, check_positive
from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.neighbours import exact_index


class SoftMatches(BriefModule):
    """A mean over the surroundings of the closest target point.

    Weights fall as exp(-d^2 / 2 h^2) with the distance d from the source point, to zero
    at the end of the nearer third. Normals are averaged likewise, with the sign of the
    closest one's.

    Attributes:
        num: target points that are looked at, the closest and those nearest to it.
        softness: h in kernel widths: the mean is taken over less as the width falls.

    Gradients: by points, normals and `softness`; which points surround one is held, and
    those that come and go have no weight.
    """

    described: ClassVar[str] = "matches such as SoftMatches()"

    num: int = eqx.field(default=24, static=True)
    softness: Array | float = traced(0.5)

    def __check_init__(self) -> None:
        """Refuses counts and numbers that it cannot use."""
        check_counts(self, num=2)
        check_positive(self, "softness")

    def among(self, points: Points, mask: Mask) -> "Surroundings":
        """The surroundings of each valid point."""
        num = min(self.num, len(mask))
        near = exact_index(len(mask)).build(points, mask).lookup_nearest(points.T, num)
        return Surroundings(near.T, jnp.asarray(self.softness, points.dtype))


class Surroundings(eqx.Module):
    """The points nearest to each target point.

    Attributes:
        near: `(m, k)` rows, that of the point itself among them; -1 for surplus.
        softness: see `SoftMatches`.
    """

    near: Int[Array, "m k"]
    softness: Scalar

    def spacing(self, points: Points, mask: Mask) -> Scalar:
        """As `median_spacing`, over all points: the mean of the middle half.

        It depends on no order of the points, and on each of them a little.
        """
        d = points.shape[1]
        other = self.near[:, min(2 * (d - 1), self.near.shape[1] - 1)]
        sq = jnp.sum((points[other] - points) ** 2, axis=1)
        use = mask & (other >= 0) & (sq > 0)
        distance = jnp.sort(jnp.where(use, jnp.sqrt(jnp.where(use, sq, 1)), jnp.inf))
        num = jnp.sum(use)
        rank = jnp.arange(len(mask))
        middle = (rank >= num // 4) & (rank < jnp.maximum(3 * num // 4, 1)) & (num > 0)
        total = jnp.sum(jnp.where(middle, distance, 0))
        return total / jnp.maximum(jnp.sum(middle), 1).astype(total.dtype)

    def blended(
        self,
        target: Float[Array, "two_d m"],
        moved: Float[Array, "d n"],
        row: Int[Array, " n"],
        width: Scalar,
    ) -> Float[Array, "two_d n"]:
        """The means of points and normals around those in `row`.

        Args:
            target: points and normals, one above the other.
            moved: source points, in the target's frame.
            row: of the closest target points.
            width: of the kernel.
        """
        d = moved.shape[0]
        rows = self.near[row]
        target = target.T
        found = target[rows]
        points, normals = found[..., :d], found[..., d:]
        sq = jnp.sum((points - moved.T[:, None]) ** 2, axis=-1)
        weight = _fading(jnp.where(rows >= 0, sq, jnp.inf), self.softness * width)
        weight = (weight / jnp.sum(weight, axis=1, keepdims=True))[..., None]
        side = jnp.sum(normals * target[row][:, None, d:], axis=-1, keepdims=True)
        normal = jnp.sum(weight * jnp.where(side < 0, -normals, normals), axis=1)
        sq = jnp.sum(normal**2, axis=1, keepdims=True)
        known = sq > 0
        normal = jnp.where(known, normal / jnp.sqrt(jnp.where(known, sq, 1)), 0)
        return jnp.concatenate([jnp.sum(weight * points, axis=1), normal], axis=1).T


def _fading(sq: Float[Array, "n k"], h: Scalar) -> Float[Array, "n k"]:
    """exp(-sq / 2 h^2), less its value at the end of the nearer third; at least zero.

    So points come and go with a weight of zero. The nearer third of those around the
    closest point are nearly always the nearest of all.
    """
    first = jnp.min(sq, axis=1, keepdims=True)
    ranked = jnp.sort(sq, axis=1)
    last = ranked[:, -(-sq.shape[1] // 3)][:, None]
    last = jnp.where(jnp.isfinite(last), last, ranked[:, 1:2])
    reach = jnp.where(last > first, last - first, 1)
    # Of an infinite h the limit, linear in the squares.
    steep = reach / (2 * h**2) + 1e-3
    inside = (sq < last) | (sq == first)
    share = (jnp.where(inside, sq, first) - first) / reach
    return jnp.where(inside, jnp.exp(-steep * share) - jnp.exp(-steep), 0)
