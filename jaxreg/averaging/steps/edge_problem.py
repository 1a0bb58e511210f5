"""Sums of robust losses over the edges of a graph, and their normal equations."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.steps.edge_errors import AbstractEdgeError
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import product
from jaxreg.robust import AbstractKernel


class Problem(NamedTuple):
    """The sum of loss(r' Omega r) over the edges; trust is its derivative."""

    graph: PoseGraph
    error: AbstractEdgeError
    precision: Array  # (e, m, m), or (e, m) if diagonal
    loss: Callable[[Array], Array]
    trust: Callable[[Array], Array]

    def squares(self, T: Array) -> Array:
        """The squared error r' Omega r of each edge."""
        r = self.errors(T)
        return jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1)

    def errors(self, T: Array) -> Array:
        """The error r of each edge."""
        return self.error.value(self.graph.predicted(T), self.graph.T_i_j)

    def _weighted(self, J: Array) -> Array:
        if self.precision.ndim == 2:
            return self.precision[..., None] * J
        return product(self.precision, J)

    def cost(self, T: Array) -> Array:
        """The objective."""
        return jnp.sum(self.loss(self.squares(T)))

    def normal(
        self, T: Array, origin: Float[Array, "v d"] | None = None
    ) -> tuple[Array, Array]:
        """J' Omega J `(e, k, k)` and J' Omega r `(e, k)` with respect to x_j - x_i.

        Of left tangents at `origin[j]`, or at the origin of the world.
        """
        predicted = self.graph.predicted(T)
        r = self.error.value(predicted, self.graph.T_i_j)
        # A left tangent of both ends turns the predicted motion from the right.
        seen = T if origin is None else moved_by(T, -origin)
        J = product(
            self.error.jacobian(predicted, r),
            lie.adjoint(lie.inverse(seen))[self.graph.edges[:, 1]],
        )
        WJ = self._weighted(J)
        force = jnp.sum(WJ * r[:, :, None], axis=-2)
        trust = self.trust(jnp.sum(r * self._weighted(r[..., None])[..., 0], axis=-1))
        Q = product(jnp.swapaxes(J, -1, -2), trust[:, None, None] * WJ)
        return Q, trust[:, None] * force


def moved_by(T: Float[Array, "v D D"], shift: Float[Array, "v d"]) -> Array:
    """The poses, shifted in the world."""
    return lie.compose(lie.rotation(T), lie.translation(T) + shift)


def robust_problem(
    graph: PoseGraph,
    error: AbstractEdgeError,
    precision: Float[Array, "e ..."],
    kernel: AbstractKernel,
    width: Float[Array, ""],
) -> Problem:
    """The problem under a robust kernel of sqrt(r' Omega r)."""
    return Problem(
        graph,
        error,
        precision,
        eqx.Partial(_loss, kernel, width),
        eqx.Partial(_trust, kernel, width),
    )


def _loss(kernel: AbstractKernel, width: Array, square: Array) -> Array:
    return 2 * kernel.rho(square, width)


def _trust(kernel: AbstractKernel, width: Array, square: Array) -> Array:
    return kernel.weight(square, width)
