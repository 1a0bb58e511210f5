"""What a group of points shows of its own error at a root that it helped to find."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import full_matmul


# Of a group that alone holds a direction: the error there may be three times its pull.
_LEAST_LEFT = 0.1


def share_left(
    led: Float[Array, "g k"],
    rows: Float[Array, "k n"],
    weight: Float[Array, " n"],
    group: Int[Array, " n"],
) -> Float[Array, " g"]:
    """One minus the leverage of each group where it leads to; 0.1 at least.

    A root follows an error that a group shares by as much of the information as is
    the group's, and the pull that is left there is smaller by that: what alone holds a
    turn pulls at nothing. Squares of pulls, divided by what is left, are in the mean as
    large as those of the errors where all errors are alike (Bell and McCaffrey 2002,
    along one direction a group in place of all).

    Args:
        led: the displacement that each group leads to.
        rows: of the Jacobian, by points.
        weight: of the points.
        group: of each point.
    """
    along = jnp.sum(rows * led[group].T, axis=0)
    own = jax.ops.segment_sum(weight * along**2, group, len(led))
    H = full_matmul(rows * weight[None], rows.T)
    of_all = jnp.sum(full_matmul(led, H) * led, axis=1)
    leverage = own / jnp.where(of_all > 0, of_all, 1)
    return jnp.maximum(1 - leverage, _LEAST_LEFT)
