"""How far a predicted motion is from a measured one, with derivatives."""

import abc
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.brief import BriefModule
from jaxreg._core.platforms import once
from jaxreg.geometry import lie
from jaxreg.graph.chordal import chordal_weights
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import product


class AbstractEdgeError(BriefModule):
    """The error of predicted motions, given the measured ones."""

    described: ClassVar[str] = "an error such as LogError()"

    @abc.abstractmethod
    def value(
        self, predicted: Float[Array, "e D D"], T_i_j: Float[Array, "e D D"]
    ) -> Float[Array, "e m"]:
        """The components of the error of each edge."""

    @abc.abstractmethod
    def jacobian(
        self, predicted: Float[Array, "e D D"], error: Float[Array, "e m"]
    ) -> Float[Array, "e m k"]:
        """Its derivative by right tangents of the predicted motions."""

    @abc.abstractmethod
    def precision(self, graph: PoseGraph) -> Float[Array, "e ..."]:
        """What the components count: `(e, m, m)`, or `(e, m)` where diagonal."""


class LogError(AbstractEdgeError):
    """log(inv(T_i_j) inv(T_world_i) T_world_j), the tangent error of g2o and GTSAM.

    It counts by the weight times the information, the identity without.
    """

    def value(
        self, predicted: Float[Array, "e D D"], T_i_j: Float[Array, "e D D"]
    ) -> Float[Array, "e k"]:
        """The tangent from the measured to the predicted motion."""
        # The last entry is one; it may be NaN.
        gap = once(lie.between, T_i_j, predicted, true=~(T_i_j[0, -1, -1] <= 0))
        return lie.log(gap)

    def jacobian(
        self, predicted: Float[Array, "e D D"], error: Float[Array, "e k"]
    ) -> Float[Array, "e k k"]:
        """The inverse right Jacobian of the group at the error."""
        return lie.log_jacobian(error)

    def precision(self, graph: PoseGraph) -> Float[Array, "e k k"]:
        """Weight times information, the identity without."""
        k = lie.tangent_dim(graph.dim)
        info = graph.information
        if info is None:
            info = jnp.eye(k, dtype=graph.weight.dtype)[None]
        return graph.weight[:, None, None] * info


class ChordalError(AbstractEdgeError):
    """The differences of the entries of the motions, with the weights of SE-Sync.

    Their weighted sum of squares is `jaxreg.metrics.chordal_objective`.
    """

    def value(
        self, predicted: Float[Array, "e D D"], T_i_j: Float[Array, "e D D"]
    ) -> Float[Array, "e m"]:
        """The entries of the rotation, then those of the translation."""
        return _entries(predicted - T_i_j)

    def jacobian(
        self, predicted: Float[Array, "e D D"], error: Float[Array, "e m"]
    ) -> Float[Array, "e m k"]:
        """The entries of the predicted motion times the generators of the group."""
        k = lie.tangent_dim(predicted.shape[-1] - 1)
        generators = jax.jacfwd(lie.exp)(jnp.zeros((k,), predicted.dtype))
        moved = product(predicted[:, None], jnp.moveaxis(generators, -1, 0)[None])
        return jnp.swapaxes(_entries(moved), -1, -2)

    def precision(self, graph: PoseGraph) -> Float[Array, "e m"]:
        """Kappa for the entries of the rotation, tau for those of the translation."""
        kappa, tau = chordal_weights(graph)
        d = graph.dim
        parts = [jnp.repeat(kappa[:, None], d * d, 1), jnp.repeat(tau[:, None], d, 1)]
        return jnp.concatenate(parts, axis=1)


def _entries(T: Array) -> Array:
    """The entries of motions or their changes, rotation first."""
    rotation, shift = T[..., :-1, :-1], T[..., :-1, -1]
    return jnp.concatenate([rotation.reshape(*shift.shape[:-1], -1), shift], axis=-1)
