"""How firmly two surfaces that agree hold each other, and whether they can slip."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.arrays import weighted_sums
from jaxreg._core.typing import Motions, Scalar
from jaxreg.geometry import lie
from jaxreg.linear import small
from jaxreg.matching.problem import Match, known
from jaxreg.matching.residuals.metric import identity, metric_equations, outer


# Planes that the gentlest motion by one radian, or radius, moves less than this many
# radii do not hold a pose. (Right pairs of scans have 0.09 and more; the side of a limb
# that fits another limb 0.02 to 0.06.)
_HELD = 0.07
# Directions that move the planes by less than this many radii are free: firmness counts
# them so. (On the modes of 1,200 pairs 0.005 to 0.03 believe as many.)
_FREE = 0.02


class Grip(eqx.Module):
    """How firmly surfaces that agree hold each other; sums, so that grips add up.

    As a surface of revolution turns in itself, and a plane slides. The squared motion
    of the planes is J^T J with J = (n, x cross n); its least eigenvalue, about their
    middle, is that of the gentlest motion (Gelfand, Ikemoto, Rusinkiewicz, Levoy:
    Geometrically stable sampling for the ICP algorithm, 2003). Points that have no
    normals hold every direction.

    Attributes:
        H: `(..., k, k)` sum of J^T J, about the origin of the frame.
        x: `(..., d)` sum of the points.
        count: `(...)` how many.
    """

    H: Float[Array, "*b k k"]
    x: Float[Array, "*b d"]
    count: Float[Array, "*b"]

    @classmethod
    def of(cls, found: Match, points: Float[Array, "d n"], share: Array) -> "Grip":
        """Of the points in `share`, where they are in the frame of the normals."""
        eye = jnp.eye(len(points), dtype=points.dtype)
        found = eqx.tree_at(lambda m: (m.source, m.R), found, (points, eye))
        weight, normal = share.astype(points.dtype), found.normal
        points_alone = identity(len(points), points.dtype)
        metric = jnp.where(known(normal)[None], outer(normal), points_alone)
        H, _ = metric_equations(found, weight, metric, jnp.zeros_like(points))
        rows = jnp.concatenate([points, jnp.ones_like(points[:1])])
        sums = weighted_sums(rows, weight)
        return cls(H, sums[:-1], sums[-1])

    def seen_from(self, T_to_here: Motions) -> "Grip":
        """In another frame."""
        A = lie.adjoint(lie.inverse(T_to_here))
        x = jnp.einsum("...ij,...j->...i", lie.rotation(T_to_here), self.x)
        x = x + self.count[..., None] * lie.translation(T_to_here)
        return Grip(jnp.swapaxes(A, -1, -2) @ self.H @ A, x, self.count)

    @property
    def holds(self) -> Bool[Array, "*b"]:
        """Whether every motion moves some planes; in frames of unit radius."""
        return (self.count > 0) & _exceeds(self._mean(), _HELD**2)

    def firmness(self, radius: Scalar) -> Float[Array, "*b"]:
        """How much of a motion the planes feel: a logarithm, at most zero.

        That of the product of what the principal motions by one radian, or radius, move
        the planes by: half the log determinant, which does not depend on the frame.
        Zero is that of planes in all directions, as far out as the cloud is. The share
        of motions that are not felt is what poses that are wrong have to choose from.

        Args:
            radius: of the smaller cloud: what is then told does not depend on the unit.
        """
        H = self._mean()
        k, d = H.shape[-1], self.x.shape[-1]
        unit = jnp.where(jnp.arange(k) < d, 1, radius)
        free = _FREE**2 * jnp.eye(k, dtype=H.dtype)
        units, free = (
            jnp.broadcast_to(x, H.shape) for x in (jnp.outer(unit, unit), free)
        )
        H = H / units + free
        return jnp.minimum(small.log_det(H) / 2 - _FIRMEST[k], 0)

    def _mean(self) -> Float[Array, "*b k k"]:
        """Of J^T J, about the middle of the points."""
        count = jnp.maximum(self.count, 1)
        middle = self.x / count[..., None]
        batch, d = middle.shape[:-1], middle.shape[-1]
        turn = lie.rotation(lie.identity(d, middle.dtype, batch))
        return self.seen_from(lie.compose(turn, -middle)).H / count[..., None, None]


# By degrees of freedom, of planes in all directions at points of unit radius: the
# mean squares of what moves them are 1 / d of a shift, 2 / 9 of a turn, 1 / 2 in 2D.
_FIRMEST = {3: 1.5 * math.log(1 / 2), 6: 1.5 * math.log(1 / 3) + 1.5 * math.log(2 / 9)}


def _exceeds(H: Float[Array, "*b k k"], least: float) -> Bool[Array, "*b"]:
    """Whether all eigenvalues are larger: all pivots of H - least I are positive.

    By Sylvester's law of inertia; elementwise, where LAPACK goes matrix by matrix.
    """
    k = H.shape[-1]
    A = [[H[..., i, j] - least * (i == j) for j in range(k)] for i in range(k)]
    positive = jnp.ones(H.shape[:-2], bool)
    for i in range(k):
        positive &= A[i][i] > 0
        inverse = 1 / jnp.where(A[i][i] > 0, A[i][i], 1)
        for j in range(i + 1, k):
            ratio = A[j][i] * inverse
            for m in range(i + 1, j + 1):
                A[j][m] = A[j][m] - ratio * A[m][i]
    return positive
