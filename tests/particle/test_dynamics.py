"""Dynamics: Eq. 6-8 as moments of many draws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion

from jaxreg.local import decoupled_error, turn_and_shift
from jaxreg.particle import (
    ConstantVelocity,
    EnsembleSpread,
    MeasuredSpread,
    NoDynamics,
    OwnSpread,
    Particles,
    PathSpread,
    StochasticDynamics,
)


P, DRAWS, TIME = 3, 4000, 2
RNG = np.random.default_rng(0)
ERROR = 0.1 * RNG.standard_normal((P, 6))
PATH = 0.1 * RNG.standard_normal((P, 4, 6))
PATH[:, TIME:] = 0
WEIGHT = np.array([0.6, 0.4, 0.0])
SPREADS = [OwnSpread(), EnsembleSpread(), MeasuredSpread(), PathSpread()]


def _particles(num: int = P) -> Particles:
    rows = np.arange(num) % P
    T = np.stack([motion(i, 3) for i in range(P)])
    return Particles(
        jnp.asarray(T[rows], jnp.float32),
        jnp.asarray(ERROR[rows], jnp.float32),
        jnp.zeros(num, jnp.float32),
        jnp.log(jnp.asarray(WEIGHT[rows] * P / num, jnp.float32)),
        jnp.asarray(PATH[rows], jnp.float32),
    )


@eqx.filter_jit
def _predicted(dynamics, particles, time, seed=0):
    """Poses, and the tangents to them from the particles."""
    T = dynamics(jax.random.key(seed), particles, jnp.asarray(time))
    return T, jax.vmap(decoupled_error)(T, particles.T_target_source)


def _steps(dynamics) -> np.ndarray:
    """`(draws, P, 6)` tangents from the particles to their predictions."""
    _, step = _predicted(dynamics, _particles(P * DRAWS), TIME)
    return np.asarray(step, np.float64).reshape(DRAWS, P, 6)


def test_without_dynamics_particles_stay():
    particles = _particles()
    T = NoDynamics()(jax.random.key(0), particles, jnp.asarray(TIME))
    np.testing.assert_array_equal(T, particles.T_target_source)


def test_constant_velocity_repeats_the_motion_error():
    particles = _particles()
    first, step = _predicted(ConstantVelocity(), particles, TIME)
    again, _ = _predicted(ConstantVelocity(), particles, TIME, 1)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_allclose(step, ERROR, atol=1e-6)


@pytest.mark.parametrize("spread", SPREADS, ids=lambda s: type(s).__name__)
def test_the_diffusion_has_the_covariance_of_the_motion_error(spread):
    outer = ERROR[:, :, None] * ERROR[:, None, :]
    S = {
        OwnSpread: outer,
        EnsembleSpread: np.tensordot(WEIGHT, outer, 1)[None].repeat(P, 0),
        # Alone, particles are all that were measured.
        MeasuredSpread: np.tensordot(WEIGHT, outer, 1)[None].repeat(P, 0),
        PathSpread: np.einsum("pti,ptj->pij", PATH, PATH) / TIME,
    }[type(spread)]
    step = _steps(StochasticDynamics(0.5, spread))
    size = np.abs(S).max()
    np.testing.assert_allclose(step.mean(0), 0, atol=0.05 * np.sqrt(size))
    found = np.einsum("spi,spj->pij", step, step) / DRAWS
    np.testing.assert_allclose(found, 0.25 * S, atol=0.03 * size)


@pytest.mark.parametrize("spread", SPREADS, ids=lambda s: type(s).__name__)
def test_the_diffusion_dies_with_the_motion_error(spread):
    T = jnp.asarray(np.stack([motion(i, 2) for i in range(P)]), jnp.float32)
    still = Particles.at(T, P, num_times=3)
    dynamics = StochasticDynamics(spread=spread)
    moved, _ = _predicted(dynamics, still, 0)
    np.testing.assert_allclose(moved, T, atol=1e-6)
    assert dynamics.needs_path == isinstance(spread, PathSpread)


def test_particles_that_resampling_drops_widen_the_measured_spread():
    before = _particles()
    kept = before.rows(jnp.zeros(P * DRAWS, int)).told(before)
    _, step = _predicted(StochasticDynamics(spread=MeasuredSpread()), kept, TIME)
    step = np.asarray(step)
    found = step.T @ step / len(step)
    # The third had no weight: it was not in use.
    S = np.mean(ERROR[:2, :, None] * ERROR[:2, None, :], axis=0)
    np.testing.assert_allclose(found, S, atol=0.03 * np.abs(S).max())


def test_the_ensemble_ignores_particles_without_weight():
    particles = _particles()
    broken = jax.tree.map(lambda x: x, particles)
    broken = Particles(
        broken.T_target_source,
        broken.motion_error.at[2].set(jnp.nan),
        broken.energy,
        broken.log_weight,
    )
    T, _ = _predicted(StochasticDynamics(spread=EnsembleSpread()), broken, 1)
    assert np.isfinite(np.asarray(T)).all()


def test_the_motion_error_is_a_left_tangent_about_the_centroid():
    T, e = jnp.asarray(motion(0, 3), jnp.float32), jnp.asarray(ERROR[0], jnp.float32)
    np.testing.assert_allclose(decoupled_error(turn_and_shift(T, e), T), e, atol=1e-6)
