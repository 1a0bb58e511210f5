"""Residuals of a match and their normal equations.

The pose is updated on the left about the origin of the lever arms,
R p + t -> exp(w) R p + t + v, with the tangent (v, w), so a point moves by
v + w x (R p). A residual contributes H = sum_i w_i J_i^T J_i and
b = sum_i w_i J_i^T r_i, and the Gauss-Newton step solves H (v, w) = b.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg.local.problem import Match


class AbstractResidual(eqx.Module):
    """What is made small.

    Attributes:
        uses_normals: whether matches also count by the agreement of their normals.
    """

    uses_normals: ClassVar[bool]

    @abc.abstractmethod
    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """H and b for the tangent (v, w), translation first."""


class PointToPoint(AbstractResidual):
    """q - (R p + t) (PF paper, Eq. 3)."""

    uses_normals: ClassVar[bool] = False

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """From the weighted second moments of lever arms and residuals."""
        moments = Moments.of(match, weight)
        total, x, xx, r, xr = (
            moments.total,
            moments.x,
            moments.xx,
            moments.r,
            moments.xr,
        )
        d = x.shape[0]
        eye = jnp.eye(d, dtype=x.dtype)
        # The Jacobian of a point is [I, G(x)] with G(x) w = w cross x.
        if d == 2:
            G = jnp.stack([-x[1], x[0]])[:, None]
            GG = jnp.trace(xx)[None, None]
            Gr = (xr[0, 1] - xr[1, 0])[None]
        else:
            G = -skew(x)
            GG = jnp.trace(xx) * eye - xx
            Gr = jnp.stack(
                [xr[1, 2] - xr[2, 1], xr[2, 0] - xr[0, 2], xr[0, 1] - xr[1, 0]]
            )
        H = jnp.block([[total * eye, G], [G.T, GG]])
        return H, jnp.concatenate([r, Gr])


class PointToPlane(AbstractResidual):
    """n . (q - (R p + t)) with the target's normal (Chen and Medioni 1992).

    In 2D, point-to-line. A small share of the point-to-point residual holds the
    directions in which a flat surface slides.

    Attributes:
        point_share: weight of the point-to-point residual beside it.
    """

    uses_normals: ClassVar[bool] = True
    point_share: Array | float = traced(0.05)

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """The Gram matrix of rows (n, x cross n, n . r), plus the share of points."""
        x, n = match.rotated, match.normal
        if x.shape[0] == 2:
            turn = [x[0] * n[1] - x[1] * n[0]]
        else:
            turn = [
                x[1] * n[2] - x[2] * n[1],
                x[2] * n[0] - x[0] * n[2],
                x[0] * n[1] - x[1] * n[0],
            ]
        rows = jnp.stack([*n, *turn, match.plane_residual])
        gram = weighted_gram(rows, weight)
        H, b = PointToPoint().normal_equations(match, weight)
        share = jnp.asarray(self.point_share, H.dtype)
        return gram[:-1, :-1] + share * H, gram[:-1, -1] + share * b


class Moments(eqx.Module):
    """Weighted sums of lever arms x and residuals r up to second order."""

    total: Float[Array, ""]
    x: Float[Array, " d"]
    r: Float[Array, " d"]
    xx: Float[Array, "d d"]
    xr: Float[Array, "d d"]

    @classmethod
    def of(cls, match: Match, weight: Float[Array, " n"]) -> "Moments":
        """All sums from one Gram matrix of the rows (1, x, r)."""
        d = match.rotated.shape[0]
        one = jnp.ones_like(weight)[None]
        rows = jnp.concatenate([one, match.rotated, match.residual])
        gram = weighted_gram(rows, weight)
        x, r = slice(1, d + 1), slice(d + 1, 2 * d + 1)
        return cls(gram[0, 0], gram[0, x], gram[0, r], gram[x, x], gram[x, r])


def weighted_gram(
    rows: Float[Array, "r n"], weight: Float[Array, " n"]
) -> Float[Array, "r r"]:
    """Rows diag(weight) rows^T in full precision on every device."""
    return jnp.matmul(rows * weight, rows.T, precision=lax.Precision.HIGHEST)


def skew(x: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix that multiplies y to give the cross product of x and y."""
    zero = jnp.zeros_like(x[0])
    return jnp.stack(
        [
            jnp.stack([zero, -x[2], x[1]]),
            jnp.stack([x[2], zero, -x[0]]),
            jnp.stack([-x[1], x[0], zero]),
        ]
    )
