"""The pose of the largest kernel correlation, by a solver of optimistix."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg._core.restarts import AbstractRestarts
from jaxreg._core.solver import Lowered, Solver
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud
from jaxreg.correlation.pairs import kernel_correlation
from jaxreg.correlation.quadratic import Quadratic
from jaxreg.geometry import lie
from jaxreg.linear.condensed import AbstractSquares, condensed
from jaxreg.local import tangent_slopes, turn_and_shift


# Beside a curvature of one by shifts: directions that are free keep still.
_DAMPING = 1e-5


class Restarting(AbstractRestarts):
    """Starts of a solver around poses, each of which raises the correlation."""

    solver: Solver
    source: PointCloud
    target: PointCloud
    bandwidth: Scalar
    limit: Scalar
    max_steps: int

    def cost(self, T: Array) -> Array:
        """Minus the correlation."""
        return -_correlation(T, self.source, self.target, self.bandwidth)

    def lowered(self, T: Array) -> tuple[Array, Lowered]:
        """Unknowns are shifts in radii and turns in radians."""
        clouds = self.source, self.target, self.bandwidth
        at = Quadratic.at(T, *clouds)
        stiffness = jnp.max(at.stiffness)
        links = _Links(T, *clouds, 1 / jnp.where(stiffness > 0, stiffness, 1))
        found = self.solver.lower(
            links.energy,
            eqx.Partial(condensed, links),
            jnp.zeros_like(at.b),
            self.max_steps,
        )
        return lie.straightened(turn_and_shift(T, found.x)), found


class _Links(AbstractSquares):
    """The energy of all pairs, see `quadratic`, times a scale."""

    T: Motion
    source: PointCloud
    target: PointCloud
    bandwidth: Scalar
    scale: Scalar

    def energy(self, x: Float[Array, " k"]) -> Float[Array, ""]:
        """But for a constant that would hide changes, and that no minimiser needs."""
        T = turn_and_shift(self.T, x)
        value = _correlation(T, self.source, self.target, self.bandwidth)
        damping = _DAMPING * jnp.sum(x * x) / 2
        return damping - self.scale * self.bandwidth**2 * value

    def value(self, x: Float[Array, " k"]) -> Float[Array, ""]:
        """All of it, a sum of squares."""
        pairs = jnp.sum(self.source.mask, dtype=x.dtype) * jnp.sum(
            self.target.mask, dtype=x.dtype
        )
        return self.energy(x) + self.scale * self.bandwidth**2 * pairs

    def normal_equations(
        self, x: Float[Array, " k"]
    ) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
        """Those of the links, which are positive where the Hessian is not."""
        T = turn_and_shift(self.T, x)
        at = Quadratic.at(T, self.source, self.target, self.bandwidth)
        J = tangent_slopes(x)
        H = self.scale * full_matmul(J.T, full_matmul(at.links, J))
        b = self.scale * jnp.sum(J * at.b[:, None], axis=0)
        return H + _DAMPING * jnp.eye(len(x), dtype=x.dtype), b - _DAMPING * x


def _correlation(
    T: Motion, source: PointCloud, target: PointCloud, bandwidth: Scalar
) -> Float[Array, ""]:
    moved = lie.act(T, source.points)
    return kernel_correlation(moved, target.points, bandwidth, source.mask, target.mask)
