"""What a particle filter carries from step to step, and what it tells of one."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.brief import BriefModule
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
        error_moment: `(k, k)` mean of e e^T over all that were measured at the time
            before, as they were before resampling. There when the dynamics are called
            in a filter, else None.
    """

    T_target_source: Float[Array, "*p D D"]
    motion_error: Float[Array, "*p k"]
    energy: Float[Array, "*p"]
    log_weight: Float[Array, "*p"]
    path: Float[Array, "*p times k"] | None = None
    error_moment: Float[Array, "k k"] | None = None

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

    def unmeasured(self) -> "Particles":
        """The same before a measurement."""
        return eqx.tree_at(
            lambda p: (p.motion_error, p.energy),
            self,
            (jnp.zeros_like(self.motion_error), jnp.full_like(self.energy, jnp.inf)),
        )

    def remembered(self, time: Int[Array, ""]) -> "Particles":
        """With the motion error in the path, where one is kept."""
        if self.path is None:
            return self
        path = self.path.at[:, time].set(self.motion_error)
        return eqx.tree_at(lambda p: p.path, self, path)

    def told(self, before: "Particles") -> "Particles":
        """With the mean of e e^T of the particles that these were resampled from."""
        live = before.log_weight > -jnp.inf
        moment = moment_of(before.motion_error, live.astype(before.energy.dtype))
        return dataclasses.replace(self, error_moment=moment)

    def valued(self, energy: Float[Array, " p"]) -> "Particles":
        """The same with other energies."""
        return eqx.tree_at(lambda p: p.energy, self, energy)

    @property
    def measurement(self) -> Motion:
        """z_t: the pose of least energy (PF paper, section 3.3, step 4)."""
        return self.T_target_source[jnp.argmin(self.energy)]


def moment_of(
    error: Float[Array, "p k"], weight: Float[Array, " p"]
) -> Float[Array, "k k"]:
    """The mean of e e^T by weight; zero where there is none."""
    # Rows out of use have no weight, but may hold errors that are not finite.
    error = jnp.where((weight > 0)[:, None] & jnp.isfinite(error), error, 0)
    total = jnp.sum(weight)
    weight = weight / jnp.where(total > 0, total, 1)
    return jnp.einsum("p,pi,pj->ij", weight, error, error)


class ParticleState(eqx.Module):
    """What the next step of a filter needs.

    Attributes:
        particles: measured and weighted at time t, poses in the frames of the problem.
            Rows that are not in use have no weight: after a step all but the first
            `num_particles`.
        num_steps: int32, t; zero after `init`.
        at_rest: whether the motion errors have died, or the first particles were sure.
        log_evidence: sum over the times of `ParticleInfo.log_evidence`, t = 0 included.
        settled: of `init`, the best particles after more steps, which the answer is
            chosen from, too; energy inf for rows that are not in use. None where
            `num_agreeing` is zero.
    """

    particles: Particles
    num_steps: Int[Array, "*b"]
    at_rest: Bool[Array, "*b"]
    log_evidence: Float[Array, "*b"]
    settled: Particles | None = None

    @property
    def T_target_source(self) -> Float[Array, "*p D D"]:
        """The poses, in the frames of the problem."""
        return self.particles.T_target_source

    @property
    def log_weight(self) -> Float[Array, "*p"]:
        """Normalised; -inf for rows that are not in use."""
        return self.particles.log_weight


class ParticleInfo(BriefModule):
    """What a person wants to know of a step; of no influence on the next.

    Attributes:
        ancestors: `(p,)` int32, the row of the state before that each of the
            `num_particles` was copied from; its own where nothing was resampled.
        log_evidence: log sum_i w_i p(z_t | x_t^i) with the weights w before the
            measurement: the logarithm of the mean of the incremental likelihoods by
            which Eq. 9 of the PF paper multiplies the weights. The likelihood is
            exp(-energy / temperature), and the temperature is learned at each time:
            compare filters of the same energy, not energies. Particles whose energy is
            not finite are left out; -inf where that is all of them.
        effective_sample_size: 1 / sum w^2 of the weights after the measurement.
        moved: the largest motion error of a particle, in radians and radii.
    """

    ancestors: Int[Array, "*p"]
    log_evidence: Float[Array, "*b"]
    effective_sample_size: Float[Array, "*b"]
    moved: Float[Array, "*b"]
