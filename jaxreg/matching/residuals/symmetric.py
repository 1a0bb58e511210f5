"""The symmetric objective."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.matching.problem import Match, inner, rotate
from jaxreg.matching.residuals.base import AbstractResidual
from jaxreg.matching.residuals.gram import cross, half_sum, weighted_gram


class Symmetric(AbstractResidual):
    """(R n_p + n_q) . (q - (R p + t)) (Rusinkiewicz 2019).

    Zero wherever both points lie on one circle through the surface, not only in its
    tangent plane: it glides along curved surfaces, and takes about half of the
    iterations of PointToPlane. The sign of n_p is taken such that it makes an acute
    angle with n_q.

    The original turns source and target by half of the rotation each, with normals
    held, so that the lever arm is the midpoint: the rotation's row is
    (x + r / 2) cross (n_p + n_q). Here the pose of the source alone moves, and its
    normal turns along: the row is x cross (n_p + n_q) + r cross n_p. The two differ by
    r cross (n_p - n_q) / 2, and only this one is the derivative of a function of the
    pose. (Leaving the normal's own rotation out doubles the iterations.)

    Directions in which all normals agree that the surface slides are free.
    """

    uses_normals: ClassVar[bool] = True

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """The Gram matrix of rows (n, x cross n + r cross n_p, n . r)."""
        gram = weighted_gram(_rows(match), weight)
        return gram[:-1, :-1], gram[:-1, -1]

    def descents(self, match: Match) -> Float[Array, "k n"]:
        """Rows (n, x cross n + r cross n_p) times n . r."""
        rows = _rows(match)
        return rows[:-1] * rows[-1:]

    def energy(self, match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
        """Sum of w ((n_p + n_q) . r)^2 / 2."""
        height = inner(_normal_sum(match), match.residual)
        return half_sum(height * height, weight)


def _rows(match: Match) -> Float[Array, "k1 n"]:
    p, n, r = _source_normal(match), _normal_sum(match), match.residual
    turn = cross(match.rotated, n) + cross(r, p)
    return jnp.concatenate([n, turn, inner(n, r)[None]])


def _source_normal(match: Match) -> Float[Array, "d n"]:
    """The source normals at the present pose, with the sign nearer to the target's."""
    sign = jnp.where(inner(match.source_normal, match.normal) < 0, -1, 1)
    sign = sign.astype(match.normal.dtype)[None]
    return sign * rotate(match.turn, match.source_normal)


def _normal_sum(match: Match) -> Float[Array, "d n"]:
    return match.normal + _source_normal(match)
