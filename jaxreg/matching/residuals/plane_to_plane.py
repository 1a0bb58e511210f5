"""Plane to plane: Generalized-ICP."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_positive
from jaxreg.matching.problem import Match, inner, known, rotate
from jaxreg.matching.residuals.base import AbstractResidual
from jaxreg.matching.residuals.gram import half_sum, wrench
from jaxreg.matching.residuals.metric import identity, metric_equations, outer


class PlaneToPlane(AbstractResidual):
    """q - (R p + t) in the metric of both surfaces (Segal, Haehnel, Thrun 2009).

    Each point stands for a disc of its surface with covariance I - (1 - epsilon) n n^T
    in its own frame; the residual counts in the inverse of the sum of both,
    M = (C_q + R C_p R^T)^-1. A point without a normal takes that of its match: where
    the source has none, this is point-to-plane. Without either it has covariance I, and
    this is PointToPoint (times 1/2).

    The eigenvectors of C_q + R C_p R^T are s = n_q + n_p, a = n_q - n_p and what is
    orthogonal to both, with eigenvalues 2 - c (1 +- n_q . n_p) and 2, c = 1 - epsilon.
    So M = I / 2 + c / 4 (s s^T / l_s + a a^T / l_a): no matrix is inverted, and the
    signs of the normals do not matter.

    M is held while the pose moves, as usual: H, b and the energy of a `moved` match
    belong to the metric of the match.

    Attributes:
        epsilon: variance along the normal over that within the surface.
    """

    uses_normals: ClassVar[bool] = True
    epsilon: Array | float = traced(1e-3)

    def __check_init__(self) -> None:
        """Refuses discs without a thickness."""
        check_positive(self, "epsilon")

    def normal_equations(
        self, match: Match, weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """Of the metric M."""
        axes = self._axes(match)
        metric = identity(len(match.residual), weight.dtype) / 2
        for direction, stiffness in axes:
            metric = metric + stiffness[None] * outer(rotate(match.R.T, direction))
        return metric_equations(match, weight, metric, _force(match, axes))

    def descents(self, match: Match) -> Float[Array, "k n"]:
        """The wrench of M r."""
        return wrench(_force(match, self._axes(match)), match.rotated)

    def energy(self, match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
        """Sum of w r^T M r / 2."""
        sq = match.sq_residual / 2
        for direction, stiffness in self._axes(match):
            sq = sq + stiffness * inner(direction, match.residual) ** 2
        return half_sum(sq, weight)

    def _axes(self, match: Match) -> list[tuple[Array, Array]]:
        """Directions s and a, and c / (4 l) of each."""
        p, q = match.source_normal, match.normal
        p = jnp.where(known(p)[None], p, q)
        q = jnp.where(known(q)[None], q, p)
        c = 1 - jnp.asarray(self.epsilon, q.dtype)
        cosine = inner(p, q)
        return [
            (q + p, c / 4 / (2 - c * (1 + cosine))),
            (q - p, c / 4 / (2 - c * (1 - cosine))),
        ]


def _force(match: Match, axes: list[tuple[Array, Array]]) -> Float[Array, "d n"]:
    """M r."""
    force = match.residual / 2
    for direction, stiffness in axes:
        along_it = stiffness * inner(direction, match.residual)
        force = force + along_it[None] * direction
    return force
