"""Resampling by optimal transport."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_positive
from jaxreg._core.typing import Key
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation
from jaxreg.particle.resamplers.base import AbstractResampler, equal
from jaxreg.particle.state import Particles


class Transport(AbstractResampler):
    """Particles moved to where the weight is, by a regularised transport of it.

    Corenflos, Thornton, Deligiannidis, Doucet 2021 (Differentiable particle filtering
    via entropy-regularized optimal transport, Algorithm 3). The plan P takes the
    weights w to equal ones of particles that are spread over those before,

        min_P  sum_ij P_ij c_ij + epsilon C sum_ij P_ij log(P_ij / w_i),
        sum_j P_ij = w_i,   sum_i P_ij = 1 / num,

    with C the mean cost, and each of them goes to the mean of what it gets, which is
    the pose of least cost: c = |t_i - t_j|^2 + |R_i - R_j|^2 / 2, squared radii and
    radians where these are small, has the mean of the translations and the rotation
    nearest to the mean of the rotations. Nothing is drawn; motion errors and paths are
    averaged, too, so that a diffusion along them is less.

    A time costs `num_steps` sweeps over p x num numbers: with as many particles as
    a search draws at first it is the longest part of it.

    Attributes:
        epsilon: of the entropy, as a share of the mean cost: small ones keep apart what
            is apart, large ones have smooth gradients.
        num_steps: of Sinkhorn's iteration, in the first half of which epsilon falls.
        threshold: see `AbstractResampler`.

    Raises: ValueError for an epsilon that is not above zero, or no step.

    Gradients: those of the steps taken, of poses by the weights and poses before and by
    `epsilon`; forward and reverse mode, in memory of p + num numbers a step. Nothing is
    left out.
    """

    epsilon: Array | float = traced(0.03)
    num_steps: int = eqx.field(default=32, static=True)
    threshold: Array | float = traced(1.0)

    def __check_init__(self) -> None:
        """Refuses a plan without entropy, and none."""
        check_positive(self, "epsilon")
        check_counts(self, num_steps=1)

    def replace(
        self, key: Key, particles: Particles, num: int
    ) -> tuple[Particles, Int[Array, " p"]]:
        """Means of equal weight."""
        del key
        T, log_weight = particles.T_target_source, particles.log_weight
        live = log_weight > -jnp.inf
        T = jnp.where(live[:, None, None], T, lie.identity(T.shape[-1] - 1, T.dtype))
        # Every so many of those in use; the first ones again where they are too few.
        order = jnp.argsort(~live, stable=True)
        places = order[jnp.arange(num) * jnp.sum(live) // num]
        cost = _cost(T, T[places])
        epsilon = jnp.asarray(self.epsilon, T.dtype)
        share = _plan(cost, log_weight, epsilon, self.num_steps)

        def mean(x: Float[Array, "p ..."]) -> Float[Array, "p ..."]:
            used = live.reshape(-1, *[1] * (x.ndim - 1))
            means = jnp.tensordot(
                share, jnp.where(used, x, 0), (0, 0), precision=lax.Precision.HIGHEST
            )
            return jnp.concatenate([means, x[num:]])

        rows = jnp.argmax(share, axis=0)
        rows = jnp.concatenate([rows, jnp.arange(num, len(live))]).astype(jnp.int32)
        R, t = mean(lie.rotation(T)), mean(lie.translation(T))
        out = Particles(
            lie.compose(nearest_rotation(R), t),
            mean(particles.motion_error),
            particles.energy[rows],
            equal(log_weight, num),
            None if particles.path is None else mean(particles.path),
        )
        return out, rows


def _cost(
    T: Float[Array, "p D D"], T_other: Float[Array, "q D D"]
) -> Float[Array, "p q"]:
    """Squared distances between poses, |t - t'|^2 + |R - R'|^2 / 2."""
    d = T.shape[-1] - 1
    cost = jnp.zeros((len(T), len(T_other)), T.dtype)
    for i in range(d):
        for j in range(d + 1):
            part = (T[:, None, i, j] - T_other[None, :, i, j]) ** 2
            cost = cost + (part if j == d else part / 2)
    return cost


def _plan(
    cost: Float[Array, "p q"],
    log_weight: Float[Array, " p"],
    epsilon: Float[Array, ""],
    num_steps: int,
) -> Float[Array, "p q"]:
    """Shares of the rows in the columns, which sum to one (Sinkhorn, by logarithms)."""
    live = log_weight > -jnp.inf
    mean_cost = jnp.sum(jnp.exp(log_weight)[:, None] * cost) / cost.shape[1]
    cost = cost / jnp.where(mean_cost > 0, mean_cost, 1)

    def shares(f: Array, eps: Array) -> Array:
        """Logarithms; whatever f is, columns are served in full."""
        level = log_weight[:, None] + (f[:, None] - cost) / eps
        return level - jax.nn.logsumexp(level, axis=0, keepdims=True)

    @jax.checkpoint
    def sweep(f: Array, eps: Array) -> tuple[Array, None]:
        # By how much rows give more than they have; those without weight give nothing.
        given = jnp.where(live[:, None], shares(f, eps), 0)
        given = jax.nn.logsumexp(given, axis=1) - math.log(cost.shape[1])
        return f - eps * jnp.where(live, given - log_weight, 0), None

    half = num_steps // 2
    falling = epsilon ** (jnp.arange(1, half + 1) / max(half, 1)).astype(cost.dtype)
    # From the mean cost down, or up to an epsilon above it.
    steps = jnp.concatenate([falling, jnp.full(num_steps - half, epsilon)])
    f, _ = control.scan(sweep, jnp.zeros_like(log_weight), steps)
    return jnp.exp(shares(f, epsilon))
