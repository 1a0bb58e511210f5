"""A few steps of averaging what agrees with poses: chains of motions drift."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core import control
from jaxreg.averaging.likelihood import Explained, Likelihood
from jaxreg.averaging.start.cycles import ROUNDS
from jaxreg.averaging.steps.kernel_width import KERNEL_DEVIATIONS, gaussian_trust
from jaxreg.geometry import lie
from jaxreg.linear.laplacian import laplacian
from jaxreg.linear.operator import divergence
from jaxreg.linear.small import product


def settled(
    likelihood: Likelihood, T_world_i: Float[Array, "v D D"]
) -> tuple[Float[Array, "v D D"], Explained]:
    """The poses after a few steps of averaging the motions that agree with them.

    A chain of motions drifts; what agrees with it shows only then. The kernel follows
    the likeliest deviation. Dense over frames. Also how the poses explain the motions.
    """

    def step(k: Array, before: tuple[Array, Explained]) -> tuple[Array, Explained]:
        T, told = before
        # One more than there are steps: what judges poses is compiled once.
        T = jnp.where(k == 0, T, _averaged(likelihood, T, told.deviation))
        return T, likelihood.explained(T)

    none = jnp.zeros((), T_world_i.dtype)
    nothing = Explained(none, none + 1, jnp.zeros_like(likelihood.graph.weight))
    return control.fori_loop(0, ROUNDS + 1, step, (T_world_i, nothing))


def _averaged(likelihood: Likelihood, T: Array, deviation: Array) -> Array:
    """After one step under a kernel."""
    graph, scale = likelihood.graph, likelihood.scale
    num, w = graph.num_poses, KERNEL_DEVIATIONS * deviation
    trust = graph.weight * gaussian_trust(graph, T, jnp.stack([w * scale, w]))
    top = jnp.max(trust)
    trust = trust / jnp.where(top > 0, top, 1)
    flow = trust[:, None] * lie.log(graph.residual_motions(T))
    rhs = divergence(graph.edges, flow, num).at[0].set(0)
    L = laplacian(graph.edges, trust, num)
    # Frames that nothing holds stay.
    ridge = 1e-5 * jnp.max(jnp.diagonal(L)) * jnp.eye(num, dtype=L.dtype)
    factor = jnp.linalg.cholesky(L + ridge)
    tangent = jax.scipy.linalg.cho_solve((factor, True), rhs)
    return lie.straightened(product(lie.exp(tangent), T))
