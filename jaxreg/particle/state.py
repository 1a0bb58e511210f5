"""The state of the particle filter."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core.typing import Motion
from jaxreg.geometry import lie


class Particles(eqx.Module):
    """Poses with what was learned when they were measured.

    Attributes:
        T_target_source: `(p, d+1, d+1)` measured poses x_t (PF paper, Eq. 4).
        motion_error: `(p, k)` measured minus predicted pose (Eq. 6), translation first.
        energy: `(p,)` of the measured pose; inf for rows that are not in use.
        log_weight: `(p,)` normalised; -inf for rows that are not in use.
        path: `(p, times, k)` motion errors of a particle's ancestors and its own, or
            None where the dynamics do not ask for them.
    """

    T_target_source: Float[Array, "*p D D"]
    motion_error: Float[Array, "*p k"]
    energy: Float[Array, "*p"]
    log_weight: Float[Array, "*p"]
    path: Float[Array, "*p times k"] | None = None

    @classmethod
    def at(
        cls, T: Float[Array, "p D D"], num: int, num_times: int | None = None
    ) -> "Particles":
        """Poses nothing is known of yet, the first `num` of them in use.

        Args:
            T: `(p, d+1, d+1)` poses.
            num: how many count; all with the same weight.
            num_times: how many motion errors their paths will hold, or None.
        """
        p, D = T.shape[:2]
        k, dtype = lie.tangent_dim(D - 1), T.dtype
        shape = None if num_times is None else (p, num_times, k)
        return cls(
            T,
            jnp.zeros((p, k), dtype),
            jnp.full(p, jnp.inf, dtype),
            jnp.where(jnp.arange(p) < num, -jnp.log(jnp.asarray(num, dtype)), -jnp.inf),
            None if shape is None else jnp.zeros(shape, dtype),
        )

    def rows(self, index: Int[Array, " q"] | slice) -> "Particles":
        """The particles of some rows."""
        return jax.tree.map(lambda x: x[index], self)

    def weighted(self, log_weight: Float[Array, " p"]) -> "Particles":
        """The same with other weights."""
        return eqx.tree_at(lambda p: p.log_weight, self, log_weight)

    def valued(self, energy: Float[Array, " p"]) -> "Particles":
        """The same with other energies."""
        return eqx.tree_at(lambda p: p.energy, self, energy)

    @property
    def measurement(self) -> Motion:
        """z_t: the pose of least energy (PF paper, section 3.3, step 4)."""
        return self.T_target_source[jnp.argmin(self.energy)]
