"""The state of the particle filter."""

import equinox as eqx
import jax
from jaxtyping import Array, Float


class Particles(eqx.Module):
    """Poses with what was learned when they were measured.

    Attributes:
        T_target_source: `(p, d+1, d+1)` measured poses x_t (PF paper, Eq. 4).
        motion_error: `(p, k)` measured minus predicted pose (Eq. 6), translation first.
        energy: `(p,)` bounded energy in [0, 1] of the measured pose.
    """

    T_target_source: Float[Array, "*p D D"]
    motion_error: Float[Array, "*p k"]
    energy: Float[Array, "*p"]

    def rows(self, index: Array) -> "Particles":
        """The particles of some rows."""
        return jax.tree.map(lambda x: x[index], self)
