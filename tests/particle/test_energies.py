"""Energies against NumPy in float64, and what a measurement does."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion
from scipy.spatial import KDTree

from jaxreg.cloud import PointCloud
from jaxreg.local import GaussNewton, LocalOptimiser, decoupled_error
from jaxreg.local.steps import AbstractStep
from jaxreg.matching import PointToPoint, Problem, match
from jaxreg.neighbours import BruteForce
from jaxreg.particle import (
    AbsoluteEnergy,
    BoundedEnergy,
    Particles,
    SquaredEnergy,
)
from jaxreg.particle.measure import measure
from jaxreg.particle.modes import distinct_modes, first_within
from jaxreg.robust import L2, AbstractKernel


N = 128
RNG = np.random.default_rng(0)
POINTS = blob(N, 3) - blob(N, 3).mean(0)
NORMALS = RNG.standard_normal((N, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
MASK = RNG.random(N) < 0.8
WIDTH = 0.2


def _problem() -> Problem:
    normals = jnp.asarray(NORMALS, jnp.float32)
    source = PointCloud(jnp.asarray(POINTS), normals, jnp.asarray(MASK))
    target = PointCloud(jnp.asarray(POINTS), normals, jnp.ones(N, bool))
    return Problem.of(source, target, BruteForce.build(target.points))


@eqx.filter_jit
def _energy_at(energy, T, width):
    return energy(match(_problem(), jnp.asarray(T)), jnp.float32(width))


_measure = eqx.filter_jit(measure)


@pytest.mark.parametrize("kind", ["bounded", "squared", "absolute"])
def test_energies_are_their_equations(kind):
    T = motion(3, 3, angle=0.3, shift=0.1)
    moved = POINTS.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    distance, row = KDTree(POINTS.astype(np.float64)).query(moved)
    cosine = np.sum((NORMALS @ T[:3, :3].T) * NORMALS[row], 1)
    height = np.sum(NORMALS[row] * (POINTS[row] - moved), 1)
    along = distance**2 - height**2
    support = 1 / (1 + (height**2 + 0.04 * along) / (0.6 * WIDTH) ** 2)
    over = (height / (1.5 * WIDTH)) ** 2
    conflict = 4 * over / (1 + over) ** 2 / (1 + (along / WIDTH**2) ** 2)
    energy, value = {
        "bounded": (
            BoundedEnergy(slide=0.2, narrow=0.6),
            1 - cosine**2 * (support - conflict),
        ),
        "squared": (SquaredEnergy(), distance**2),
        "absolute": (AbsoluteEnergy(0.05), np.sqrt(distance**2 + 0.05**2)),
    }[kind]
    found = _energy_at(energy, T.astype(np.float32), WIDTH)
    assert float(found) == pytest.approx(value[MASK].mean(), rel=1e-4)


def test_only_the_bounded_energy_is_bounded():
    here = np.eye(4, dtype=np.float32)
    far = here.copy()
    far[0, 3] = 1e6
    assert abs(float(_energy_at(BoundedEnergy(), here, 0.1))) < 1e-6
    bounded, squared, absolute = (
        float(_energy_at(of, far, 0.1))
        for of in (BoundedEnergy(), SquaredEnergy(), AbsoluteEnergy())
    )
    assert 0.99 < bounded <= 1
    assert squared == pytest.approx(1e12, rel=1e-3)
    assert absolute == pytest.approx(1e6, rel=1e-3)


def test_measurement_descends_and_reports_what_it_moved():
    problem, energy = _problem(), SquaredEnergy()
    optimiser = LocalOptimiser(PointToPoint(), L2(), GaussNewton())
    T = np.stack([motion(s, 3, angle=0.2, shift=0.05) for s in range(8)])
    start = Particles.at(jnp.asarray(T, jnp.float32), 8)
    T = start.T_target_source
    width = jnp.asarray(0.2)
    out = _measure(
        problem,
        optimiser,
        energy,
        start,
        T,
        (width, width),
        num_rows=5,
        num_steps=5,
        batch_size=2,
    )
    before = jax.jit(jax.vmap(lambda T: energy(match(problem, T), width)))(T)
    assert np.all(np.asarray(out.energy)[:6] < np.asarray(before)[:6])
    np.testing.assert_array_equal(out.energy[6:], np.inf)
    moved = jax.jit(jax.vmap(decoupled_error))(out.T_target_source, T)
    np.testing.assert_allclose(out.motion_error, moved, atol=1e-6)
    best = np.argmin(out.energy)
    np.testing.assert_array_equal(out.measurement, out.T_target_source[best])


class _Width(AbstractKernel):
    def rho(self, sq_residual, width):
        return 0 * sq_residual

    def weight(self, sq_residual, width):
        return width + 0 * sq_residual

    def width_of(self, sq_residual, mask):
        return sq_residual[0]


class _ByWeight(AbstractStep):
    def __call__(self, T_target_source, match, weight, residual):
        return T_target_source.at[0, 3].add(jnp.max(weight))


@pytest.mark.parametrize("num_steps", [1, 2, 5])
def test_kernel_widths_go_from_the_first_to_the_last_by_one_factor(num_steps):
    T = jnp.eye(4)[None]
    out = _measure(
        _problem(),
        LocalOptimiser(PointToPoint(), _Width(), _ByWeight()),
        SquaredEnergy(),
        Particles.at(T, 1),
        T,
        (jnp.asarray(0.8), jnp.asarray(0.05)),
        num_rows=1,
        num_steps=num_steps,
        batch_size=1,
    )
    shift = np.geomspace(0.8, 0.05, num_steps).sum()
    np.testing.assert_allclose(out.motion_error[0, 0], shift, rtol=1e-5)


def test_modes_are_distinct_best_first_and_share_the_weight():
    poses = [np.eye(4), motion(1, 3), motion(2, 3)]
    rows = np.array([0, 1, 0, 2, 1, 0, 2])
    T = jnp.asarray(np.stack([poses[r] for r in rows]), jnp.float32)
    value = jnp.asarray([0.3, 0.1, 0.31, 0.9, 0.12, 0.32, 0.01])
    weight = jnp.asarray([0.1, 0.3, 0.1, 0.05, 0.3, 0.15, 0])
    particles = Particles(T, jnp.zeros((7, 6)), value, jnp.log(weight))
    limit = jnp.asarray(0.1)
    row, mass = distinct_modes(particles, 4, angle=limit, distance=limit)
    np.testing.assert_array_equal(row[:3], [1, 0, 3])
    np.testing.assert_allclose(mass, [0.6, 0.35, 0.05, 0], atol=1e-6)


def test_poses_that_coincide_count_as_the_first_of_them():
    poses = [np.eye(4), motion(1, 3), motion(2, 3), np.full((4, 4), np.nan)]
    T = jnp.asarray(np.stack([poses[r] for r in (1, 0, 1, 2, 0, 3)]), jnp.float32)
    limit = jnp.asarray(0.1)
    first = first_within(T, angle=limit, distance=limit)
    np.testing.assert_array_equal(first, [0, 1, 0, 3, 1, 5])
