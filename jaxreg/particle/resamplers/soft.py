"""Soft resampling."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_parts, check_shares
from jaxreg._core.typing import Key
from jaxreg.particle.resamplers.base import AbstractHardResampler, AbstractResampler
from jaxreg.particle.resamplers.systematic import Systematic
from jaxreg.particle.state import Particles
from jaxreg.particle.weights import normalised


class Soft(AbstractResampler):
    """Copies drawn from q = alpha w + (1 - alpha) / n, which weigh w / q after.

    Karkus, Hsu, Lee 2018 (Particle filter networks, Eq. 6-7). Between resampling
    proper (alpha of one) and none: particles of little weight live on in some copies,
    and weights after depend on those before. Normalised, so that weighted means are
    right up to one part in the number of particles.

    Attributes:
        alpha: share of the copies that is drawn by weight.
        draws: how copies are drawn.
        threshold: see `AbstractResampler`.

    Raises: ValueError for an alpha that is not above zero, or above one.

    Gradients: of poses and weights, by all that these depend on and by `alpha`, with
    the copies held. Which are drawn jumps, and is left out: the bias that is left is
    less the less alpha is, and there is none where all are drawn alike.
    """

    alpha: Array | float = traced(0.5)
    draws: AbstractHardResampler = eqx.field(default_factory=Systematic)
    threshold: Array | float = traced(1.0)

    def __check_init__(self) -> None:
        """Refuses shares that are none."""
        check_shares(self, "alpha")
        check_parts(self, draws=AbstractHardResampler)

    def replace(
        self, key: Key, particles: Particles, num: int
    ) -> tuple[Particles, Int[Array, " p"]]:
        """Copies of corrected weights."""
        log_weight = particles.log_weight
        live = log_weight > -jnp.inf
        weight = jnp.exp(log_weight)
        alike = live / jnp.maximum(jnp.sum(live), 1).astype(weight.dtype)
        alpha = jnp.asarray(self.alpha, weight.dtype)
        share = alpha * weight + (1 - alpha) * alike
        rows = self.draws.ancestors(key, lax.stop_gradient(share), num)
        correction = log_weight[rows] - jnp.log(share[rows])
        after = normalised(correction, jnp.arange(len(rows)) < num)
        return particles.rows(rows).weighted(after), rows
