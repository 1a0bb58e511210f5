"""What a step of the filter writes down of its particles."""

import jax.numpy as jnp
from jax import lax

from jaxreg._core.quantile import masked_quantile
from jaxreg._core.typing import Scalar
from jaxreg.particle.state import Particles
from jaxreg.particle.weights import effective_sample_size
from jaxreg.registrar import SearchTrace


def no_rows(num: int, dtype: jnp.dtype) -> SearchTrace:
    """Room for the rows of a trace."""
    zero = jnp.zeros(num, dtype)
    none = jnp.zeros((), jnp.int32)
    return SearchTrace(none, jnp.zeros(num, jnp.int32), zero, zero, zero, zero)


def with_row(
    trace: SearchTrace, particles: Particles, kernel_width: Scalar
) -> SearchTrace:
    """With one more row, of the measured particles that have a weight."""
    energy = particles.energy
    measured = jnp.isfinite(energy) & (particles.log_weight > -jnp.inf)
    count = jnp.sum(measured, dtype=jnp.int32)
    least = jnp.min(jnp.where(measured, energy, jnp.inf), initial=jnp.inf)
    new = {
        "num_measured": count,
        "least_energy": jnp.where(count > 0, least, 0),
        "median_energy": masked_quantile(energy, measured, 0.5),
        "effective_size": effective_sample_size(particles.log_weight),
        "kernel_width": kernel_width,
    }
    row = trace.num_rows
    rows = {
        name: lax.dynamic_update_index_in_dim(getattr(trace, name), value, row, 0)
        for name, value in new.items()
    }
    return SearchTrace(row + 1, **rows)
