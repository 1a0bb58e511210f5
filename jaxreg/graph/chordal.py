"""SE-Sync's precisions of rotations and translations.

Rosen, Carlone, Bandeira, Leonard, SE-Sync: A certifiably correct algorithm for
synchronization over the special Euclidean group.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import inverse


def chordal_weights(
    graph: PoseGraph,
) -> tuple[Float[Array, " e"], Float[Array, " e"]]:
    """SE-Sync's precisions kappa (rotation) and tau (translation) of each edge.

    From the blocks I_tt and I_rr of the information: in 3D tau = 3 / tr(inv(I_tt)) and
    kappa = 3 / (2 tr(inv(I_rr))), in 2D tau = 2 / tr(inv(I_tt)) and kappa = I_rr. Both
    are times the prior weight, and 1 without information; 0 where masked.
    """
    if graph.information is None:
        return graph.weight, graph.weight
    d = graph.dim
    real = graph.mask & (graph.weight > 0)
    k = graph.information.shape[-1]
    eye = jnp.eye(k, dtype=graph.weight.dtype)
    info = jnp.where(real[:, None, None], graph.information, eye)
    tau = d / jnp.trace(inverse(info[:, :d, :d]), axis1=-2, axis2=-1)
    if d == 2:
        kappa = info[:, 2, 2]
    else:
        covariance = inverse(info[:, d:, d:])
        kappa = 1.5 / jnp.trace(covariance, axis1=-2, axis2=-1)
    return graph.weight * kappa, graph.weight * tau
