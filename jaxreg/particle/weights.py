"""Weights as logarithms (PF paper, Eq. 9; section 3.3, step 2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.typing import Scalar


# Where an effective sample size differs by such a share from that asked for, or hardly
# changes with the temperature, none has that size: the temperature is a bound.
_NEAR, _FLAT = 1e-2, 1e-3


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

    Gradients: by the energies, the size and the coldest, of the temperature, too, to
    first order.
    """
    finite = jnp.isfinite(energy)
    known = jnp.any(finite)
    low = jnp.where(known, jnp.min(jnp.where(finite, energy, jnp.inf)), 0)
    excess = jnp.where(finite, energy - low, 0)
    size = jnp.asarray(target_size, energy.dtype)
    temperature = jnp.maximum(_temperature(excess, finite, size), coldest)
    best = jnp.where(known, -low / temperature, -jnp.inf)
    relative = jnp.where(finite, -excess / temperature, -jnp.inf)
    return Likelihood(jnp.where(known, relative, 0), best)


def _temperature(
    excess: Float[Array, " p"], counts: Bool[Array, " p"], target_size: Scalar
) -> Scalar:
    """That at which exp(-excess / temperature) has an effective sample size.

    Gradients: those of the equation that it solves, to first order; where none
    does, those of the largest excess, by which temperatures are bounded.
    """

    def size_at(temperature: Array, excess: Array) -> Array:
        weight = jnp.where(counts, jnp.exp(-excess / temperature), 0)
        return jnp.sum(weight) ** 2 / jnp.maximum(jnp.sum(weight**2), 1)

    span = jnp.max(excess)
    span = jnp.where(span > 0, span, 1)
    held, wanted, unit = lax.stop_gradient((excess, target_size, span))

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        cold, hot = bounds
        middle = jnp.sqrt(cold * hot)
        small = size_at(middle, held) < wanted
        return jnp.where(small, middle, cold), jnp.where(small, hot, middle)

    found = control.fori_loop(0, 24, halve, (unit * 1e-4, unit * 1e3))[1]
    size, slope = jax.jvp(lambda T: size_at(T, held), (found,), (jnp.ones_like(found),))
    near = jnp.abs(size - wanted) < _NEAR * wanted
    solvable = near & (slope * found > _FLAT * size)
    # Newton's step from held numbers has the derivative of what it leads to.
    step = (target_size - size_at(found, excess)) / jnp.where(solvable, slope, 1)
    return jnp.where(solvable, found + step, found / unit * span)
