"""Sums of robust losses over the edges of a graph, and their normal equations."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.platforms import once
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
        return jnp.sum(r * self._weighted(r), axis=-1)

    def errors(self, T: Array) -> Array:
        """The error r of each edge."""
        return self._errors(self._predicted(T))

    def _predicted(self, T: Array) -> Array:
        return once(self.graph.predicted, T, true=self._true)

    def _errors(self, predicted: Array) -> Array:
        return once(self.error.value, predicted, self.graph.T_i_j, true=self._true)

    def _weighted(self, r: Array) -> Array:
        """Omega r."""
        if self.precision.ndim == 2:
            return self.precision * r
        return once(product, self.precision, r[..., None], true=self._true)[..., 0]

    @property
    def _true(self) -> Bool[Array, ""]:
        return self.graph.edges[0, 0] >= 0

    def cost(self, T: Array) -> Array:
        """The objective."""
        return jnp.sum(self.loss(self.squares(T)))

    def normal(self, T: Array, origin: Float[Array, "v d"] | None = None) -> "Normal":
        """With respect to x_j - x_i, left tangents at `origin[j]`, or at 0."""
        predicted = self._predicted(T)
        r = self._errors(predicted)
        # A left tangent of both ends turns the predicted motion from the right.
        seen = T if origin is None else moved_by(T, -origin)
        turn = lie.adjoint(lie.inverse(seen))[self.graph.edges[:, 1]]
        J = product(self.error.jacobian(predicted, r), turn)
        Wr = self._weighted(r)
        trust = self.trust(jnp.sum(r * Wr, axis=-1))
        force = jnp.sum(J * Wr[:, :, None], axis=-2)
        if self.precision.ndim == 2:
            WJ = self.precision[..., None] * J
        else:
            WJ = product(self.precision, J)
        Q = product(jnp.swapaxes(J, -1, -2), trust[:, None, None] * WJ)
        return Normal(Q, trust[:, None] * force, trust)


class Normal(NamedTuple):
    """What the edges give to the normal equations."""

    stiffness: Float[Array, "e k k"]  # J' Omega J
    force: Float[Array, "e k"]  # J' Omega r
    trust: Float[Array, " e"]


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
