"""Weights as logarithms (PF paper, Eq. 9; section 3.3, step 2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxreg._core.typing import Scalar


def effective_sample_size(log_weight: Float[Array, " p"]) -> Scalar:
    """(sum w)^2 / sum w^2: between 1 and p, whatever the scale of the weights."""
    return jnp.exp(2 * jax.nn.logsumexp(log_weight) - jax.nn.logsumexp(2 * log_weight))


def normalised(
    log_weight: Float[Array, " p"], live: Bool[Array, " p"]
) -> Float[Array, " p"]:
    """Scaled to a sum of one over the live rows, the others without weight.

    Where no live row has a weight, all of them get the same.
    """
    usable = live & (log_weight > -jnp.inf)
    usable = jnp.where(jnp.any(usable), usable, live)
    level = jnp.where(jnp.isfinite(log_weight), log_weight, 0)
    level = jnp.where(usable, level, -jnp.inf)
    level = level - jnp.max(level)  # before rounding takes its digits
    return level - jax.nn.logsumexp(level)


class Likelihood(NamedTuple):
    """p(z_t | x_t) = exp(-energy / temperature), as logarithms.

    Attributes:
        relative: `(p,)` over that of the best particle, which has zero; -inf where the
            energy is not finite, zero for all where that is all of them.
        best: of that particle; -inf where no energy is finite.
    """

    relative: Float[Array, " p"]
    best: Float[Array, ""]

    def log_mean(self, log_weight: Float[Array, " p"]) -> Float[Array, ""]:
        """Log of the mean by weight, over the particles that have a likelihood."""
        counts = jnp.isfinite(self.relative) & jnp.isfinite(log_weight)
        known = jnp.any(counts) & jnp.isfinite(self.best)
        level = jnp.where(counts, log_weight, -jnp.inf)
        level = jnp.where(known, level, 0)
        mean = jax.nn.logsumexp(level + jnp.where(counts, self.relative, 0))
        return jnp.where(known, self.best + mean - jax.nn.logsumexp(level), -jnp.inf)


def likelihood(
    energy: Float[Array, " p"], target_size: Array | float, coldest: Array | float = 0
) -> Likelihood:
    """Of measured particles.

    The paper's exponent, a sum over all points, has the wrong sign and underflows.
    Here the energies themselves set the temperature: the likelihoods have the given
    effective sample size, so that there is no schedule to choose, or a larger one where
    the temperature would fall below the `coldest`: poses that the points do not tell
    apart, as those of a symmetric object, stay equally likely.
    """
    finite = jnp.isfinite(energy)
    low = jnp.min(jnp.where(finite, energy, jnp.inf))
    excess = jnp.where(finite, energy - jnp.where(jnp.isfinite(low), low, 0), jnp.inf)
    span = jnp.max(jnp.where(finite, excess, 0))
    span = jnp.where(span > 0, span, 1)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        cold, hot = bounds
        middle = jnp.sqrt(cold * hot)
        weight = jnp.exp(-excess / middle)
        size = jnp.sum(weight) ** 2 / jnp.maximum(jnp.sum(weight**2), 1)
        small = size < target_size
        return jnp.where(small, middle, cold), jnp.where(small, hot, middle)

    temperature = lax.fori_loop(0, 24, halve, (span * 1e-4, span * 1e3))[1]
    temperature = jnp.maximum(temperature, coldest)
    known = jnp.any(finite)
    best = jnp.where(known, -jnp.where(known, low, 0) / temperature, -jnp.inf)
    return Likelihood(jnp.where(known, -excess / temperature, 0), best)
