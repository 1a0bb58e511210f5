"""Normal equations free of units, and what their eigenvalues say.

Translations are lengths and rotations are radians. Counted in radii of gyration, the
rotations become lengths too: of a point-to-point residual on an even cloud, every
diagonal entry of H is then the same.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.linear.small import eigh, solve_semidefinite
from jaxreg.matching.problem import Match, inner
from jaxreg.matching.residuals.gram import half_sum


class Scaled(eqx.Module):
    """H x = b with x = unit * (v, w), scaled such that the mean stiffness is one.

    Attributes:
        H: `(k, k)`; the mean of its translation's diagonal is one.
        b: `(k,)`.
        unit: `(k,)` what one unit of the solution is in the tangent.
        scale: one over the stiffness: what H and b were multiplied by.
    """

    H: Float[Array, "k k"]
    b: Float[Array, " k"]
    unit: Float[Array, " k"]
    scale: Float[Array, ""]

    @classmethod
    def of(
        cls,
        H: Float[Array, "k k"],
        b: Float[Array, " k"],
        match: Match,
        weight: Float[Array, " n"],
    ) -> "Scaled":
        """Divides translation by its stiffness and rotation by the gyration too."""
        d = match.source.shape[0]
        radius = gyration_radius(match, weight)
        stiffness = jnp.trace(H[:d, :d]) / d
        turn = jnp.where(radius > 0, 1 / jnp.where(radius > 0, radius, 1), 1)
        unit = jnp.concatenate(
            [jnp.ones(d, H.dtype), jnp.broadcast_to(turn, (b.shape[0] - d,))]
        )
        scale = jnp.where(stiffness > 0, 1 / jnp.where(stiffness > 0, stiffness, 1), 0)
        both = scale * H * unit[:, None] * unit[None]
        return cls(both, scale * b * unit, unit, scale)

    def solve(self, damping: Float[Array, ""] | float) -> Float[Array, " k"]:
        """The tangent (v, w) that solves (H + damping I) x = b.

        A direction that the data leave free, whose eigenvalue is far below the
        damping, is left alone.
        """
        eye = jnp.eye(self.b.shape[0], dtype=self.b.dtype)
        damped = self.H + jnp.asarray(damping, self.b.dtype) * eye
        return self.unit * solve_semidefinite(damped, self.b)


def gyration_radius(match: Match, weight: Float[Array, " n"]) -> Float[Array, ""]:
    """Root mean square distance to an axis of rotation, of the weighted lever arms.

    The mean is taken over the d axes as well; in the unit of the points. Zero where
    all weights are.
    """
    d = match.source.shape[0]
    total = jnp.sum(weight)
    square = 2 * half_sum(inner(match.source, match.source), weight)
    share = 1 if d == 2 else 2 / 3
    mean = share * square / jnp.where(total > 0, total, 1)
    return jnp.sqrt(jnp.where(mean > 0, mean, 1)) * (mean > 0)


def condition(
    H: Float[Array, "k k"], radius: Float[Array, ""] | float = 1.0
) -> Float[Array, ""]:
    """Least over greatest eigenvalue of H with rotations counted in lengths.

    Near one where the data hold all directions alike, zero where they leave one free;
    float32 resolves down to 1e-6. Take H of a residual without a point share: that
    holds every direction.

    Args:
        H: `(k, k)`, translation first, about a point near the middle of the source.
        radius: length of the lever arms, in the unit of the points: `gyration_radius`,
            or one in the frames that `register` prepares.

    Returns:
        In [0, 1]; zero where H is zero or not finite.
    """
    d = 2 if H.shape[0] == 3 else 3
    r = jnp.asarray(radius, H.dtype)
    turn = 1 / jnp.where(r > 0, r, 1)
    unit = jnp.where(jnp.arange(H.shape[0]) < d, 1, turn)
    scaled = H * unit[:, None] * unit[None]
    finite = jnp.all(jnp.isfinite(scaled))
    value = eigh(jnp.where(finite, scaled, 0))[0]
    good = finite & (value[-1] > 0)
    ratio = value[0] / jnp.where(good, value[-1], 1)
    return jnp.where(good, jnp.clip(ratio, 0, 1), 0)
