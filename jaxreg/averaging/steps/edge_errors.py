"""How far a predicted motion is from a measured one, with derivatives."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, chordal_weights, product


class EdgeError(NamedTuple):
    """The error of predicted motions `(e, D, D)`."""

    value: Callable[[Array, Array], Array]  # (e, m), given the measured ones, too
    jacobian: Callable[[Array, Array], Array]  # (e, m, k) to right tangents, given both


def _log_error(predicted: Array, T_i_j: Array) -> Array:
    return lie.log(product(lie.inverse(T_i_j), predicted))


#: The tangent error of g2o and GTSAM.
LOG_ERROR = EdgeError(_log_error, lambda _, r: lie.log_jacobian(r))


def log_precision(graph: PoseGraph) -> Float[Array, "e k k"]:
    """Weight times information, the identity without."""
    k = lie.tangent_dim(graph.dim)
    info = graph.information
    if info is None:
        info = jnp.eye(k, dtype=graph.weight.dtype)
    return graph.weight[:, None, None] * info


def _entries(T: Array) -> Array:
    """The entries of motions or their changes, rotation first."""
    rotation, shift = T[..., :-1, :-1], T[..., :-1, -1]
    return jnp.concatenate([rotation.reshape(*shift.shape[:-1], -1), shift], axis=-1)


def _chordal_jacobian(predicted: Array, _: Array) -> Array:
    k = lie.tangent_dim(predicted.shape[-1] - 1)
    generators = jax.jacfwd(lie.exp)(jnp.zeros((k,), predicted.dtype))
    moved = product(predicted[:, None], jnp.moveaxis(generators, -1, 0)[None])
    return jnp.swapaxes(_entries(moved), -1, -2)


#: Entries of the motions, with the weights of SE-Sync.
CHORDAL_ERROR = EdgeError(lambda P, T_i_j: _entries(P - T_i_j), _chordal_jacobian)


def chordal_precision(graph: PoseGraph) -> Float[Array, "e m"]:
    """Of the entries of a motion: kappa of its rotation, tau of its shift."""
    kappa, tau = chordal_weights(graph)
    d = graph.dim
    parts = [jnp.repeat(kappa[:, None], d * d, 1), jnp.repeat(tau[:, None], d, 1)]
    return jnp.concatenate(parts, axis=1)
