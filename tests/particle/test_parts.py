"""Prior, diffusion, measurement and modes of the filter."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import blob, motion, pose_error

from jaxreg.cloud import PointCloud
from jaxreg.local import (
    GaussNewton,
    LocalOptimiser,
    PointToPoint,
    Problem,
    decoupled_error,
)
from jaxreg.neighbours import BruteForce
from jaxreg.particle import Particles, prior
from jaxreg.particle.measure import energy, measure
from jaxreg.particle.modes import distinct_modes
from jaxreg.particle.predict import diffuse
from jaxreg.robust import L2


def _problem() -> Problem:
    points = jnp.asarray(blob(128, 3))
    points = points - points.mean(0)
    cloud = PointCloud(points, jnp.zeros_like(points), jnp.ones(128, bool))
    return Problem.of(cloud, cloud, BruteForce.build(points))


def test_energy_is_zero_at_a_perfect_fit_and_bounded_far_away():
    problem, width = _problem(), jnp.asarray(0.1)
    T = jnp.eye(4)
    assert abs(float(energy(problem, T, width))) < 1e-6
    assert 0.99 < float(energy(problem, T.at[0, 3].set(1e6), width)) <= 1


def test_measurement_descends_and_reports_what_it_moved():
    problem = _problem()
    optimiser = LocalOptimiser(PointToPoint(), L2(), GaussNewton())
    start = jnp.stack(
        [jnp.asarray(motion(s, 3, angle=0.2, shift=0.05)) for s in range(8)]
    ).astype(jnp.float32)
    width = jnp.asarray(0.2)
    out = measure(
        problem, optimiser, start, width, num_rows=6, num_steps=5, batch_size=2
    )
    before = jax.vmap(lambda T: energy(problem, T, width))(start)
    assert np.all(np.asarray(out.energy)[:6] < np.asarray(before)[:6])
    np.testing.assert_array_equal(out.energy[6:], np.inf)
    moved = jax.vmap(decoupled_error)(out.T_target_source, start)
    np.testing.assert_allclose(out.motion_error, moved, atol=1e-6)


def test_diffusion_has_the_covariance_of_the_motion_error():
    # Eq. 7, 8: S = e e^T, mean at the particle; it dies with the error.
    error = jnp.asarray([0.1, -0.2, 0.05, 0.0, 0.02, -0.01])
    T = jnp.asarray(motion(1, 3), jnp.float32)
    p = 4000
    particles = Particles(
        jnp.broadcast_to(T, (p, 4, 4)), jnp.broadcast_to(error, (p, 6)), jnp.zeros(p)
    )
    moved = diffuse(jax.random.key(0), particles, 1.0)
    tangent = np.asarray(jax.vmap(decoupled_error, (0, None))(moved, T))
    np.testing.assert_allclose(tangent.mean(0), 0, atol=0.01)
    np.testing.assert_allclose(
        tangent.T @ tangent / p, np.outer(error, error), atol=2e-3
    )
    np.testing.assert_allclose(
        diffuse(jax.random.key(0), particles, 0.0), particles.T_target_source, atol=1e-6
    )


def test_gaussian_prior_keeps_the_guess_and_spreads_around_it():
    T = jnp.asarray(motion(2, 3), jnp.float32)
    spread = jnp.asarray(0.2)
    drawn = prior.gaussian(jax.random.key(0), 4000, T, spread, spread / 2)
    assert pose_error(drawn[0], T)[0] < 1e-5
    tangent = np.asarray(jax.vmap(decoupled_error, (0, None))(drawn, T))
    np.testing.assert_allclose(tangent.std(0), [0.2] * 3 + [0.1] * 3, rtol=0.1)


def test_modes_are_distinct_best_first_and_share_the_weight():
    poses = [np.eye(4), motion(1, 3), motion(2, 3)]
    rows = np.array([0, 1, 0, 2, 1, 0])
    T = jnp.asarray(np.stack([poses[r] for r in rows]), jnp.float32)
    value = jnp.asarray([0.3, 0.1, 0.31, 0.9, 0.12, 0.32])
    weight = jnp.asarray([0.1, 0.3, 0.1, 0.05, 0.3, 0.15])
    particles = Particles(T, jnp.zeros((6, 6)), value)
    limit = jnp.asarray(0.1)
    row, mass = distinct_modes(particles, weight, 4, angle=limit, distance=limit)
    np.testing.assert_array_equal(row[:3], [1, 0, 3])
    np.testing.assert_allclose(mass, [0.6, 0.35, 0.05, 0], atol=1e-6)
