"""The box that holds the bulk of some points."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import spread_rows
from jaxreg._core.typing import Mask, Points


# The box reaches from the median of this many points as many median distances. A grid
# is as fine as its box is small: a scanner sees half of its points within a tenth of
# its range, and two strays at the end of it would make every cell as wide as a room.
_SAMPLES = 256
_REACH = 4


def bulk_extent(
    points: Points, mask: Mask
) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """Lowest and highest corner around the valid points but few that are far away.

    Of none the first is inf and the second -inf, or NaN.
    """
    some, use = spread_rows(mask, _SAMPLES)
    sample = jnp.where(use[:, None], points[some], jnp.nan)
    centre = jnp.nanmedian(sample, axis=0)
    reach = _REACH * jnp.nanmedian(jnp.max(jnp.abs(sample - centre[None]), axis=1))
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    return jnp.maximum(low, centre - reach), jnp.minimum(high, centre + reach)
