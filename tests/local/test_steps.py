"""The normal equations and steps against automatic differentiation and Kabsch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move

from jaxreg.cloud import PointCloud
from jaxreg.geometry.kabsch import kabsch
from jaxreg.local import (
    ClosedForm,
    GaussNewton,
    PointToPlane,
    PointToPoint,
    Problem,
    decoupled_error,
    match,
    turn_and_shift,
)
from jaxreg.neighbours import BruteForce


N = 60


def _match(d: int):
    rng = np.random.default_rng(0)
    source = blob(N, d).astype(float)
    source -= source.mean(0)
    target = move(motion(1, d, angle=0.2, shift=0.1), source)
    normals = rng.standard_normal((N, d))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mask = jnp.ones(N, bool)
    source, target, normals = map(jnp.asarray, (source, target, normals))
    problem = Problem.of(
        PointCloud(source, normals, mask),
        PointCloud(target, normals, mask),
        BruteForce.build(target),
    )
    T = jnp.asarray(motion(2, d, angle=0.1, shift=0.05))
    return problem, T, match(problem, T), jnp.asarray(rng.uniform(0.1, 1, N))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("residual", [PointToPoint(), PointToPlane(0.3)])
def test_normal_equations_are_those_of_the_linearised_residual(d, residual):
    with jax.enable_x64(True):
        problem, T, found, weight = _match(d)
        target = problem.target[found.row, :d].T

        def residuals(tangent):
            moved = turn_and_shift(T, tangent)
            points = moved[:d, :d] @ problem.source + moved[:d, d:]
            r = target - points
            if isinstance(residual, PointToPoint):
                return r
            plane = jnp.sum(found.normal * r, axis=0)[None]
            return jnp.concatenate([plane, jnp.sqrt(0.3) * r])

        zero = jnp.zeros(3 if d == 2 else 6)
        J = -jax.jacfwd(residuals)(zero)
        H = jnp.einsum("n,rni,rnj->ij", weight, J, J)
        b = jnp.einsum("n,rni,rn->i", weight, J, residuals(zero))
        mine = residual.normal_equations(found, weight)
        np.testing.assert_allclose(mine[0], H, atol=1e-9)
        np.testing.assert_allclose(mine[1], b, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_closed_form_is_kabsch_of_the_matched_points(d):
    with jax.enable_x64(True):
        problem, T, found, weight = _match(d)
        target = problem.target[found.row, :d]
        expected = kabsch(problem.source.T, target, weight)
        T_new = ClosedForm()(T, found, weight, PointToPoint())
        np.testing.assert_allclose(T_new, expected, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_gauss_newton_converges_to_the_closed_form_with_matches_held(d):
    with jax.enable_x64(True):
        problem, T, found, weight = _match(d)
        target = problem.target[found.row]
        row = jnp.arange(N)
        held = Problem(
            problem.source,
            problem.source_normals,
            problem.source_mask,
            target,
            _Identity(target[:, :d], problem.source_mask),
        )
        for _ in range(8):
            T = GaussNewton(0.0)(T, match(held, T), weight, PointToPoint())
        assert row.shape == found.row.shape
        expected = kabsch(problem.source.T, target[:, :d], weight)
        np.testing.assert_allclose(T, expected, atol=1e-8)


class _Identity(BruteForce):
    """Correspondences row by row."""

    def lookup(self, columns):
        return jnp.arange(columns.shape[1], dtype=jnp.int32)


@pytest.mark.parametrize("step", [ClosedForm(), GaussNewton()])
def test_zero_weights_leave_the_pose(step):
    _, T, found, weight = _match(3)
    T_new = step(T, found, 0 * weight, PointToPoint())
    np.testing.assert_allclose(T_new, T, atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_motion_error_undoes_the_update(d):
    with jax.enable_x64(True):
        T = jnp.asarray(motion(3, d))
        tangent = 0.1 * jnp.arange(1.0, 4.0 if d == 2 else 7.0)
        error = decoupled_error(turn_and_shift(T, tangent), T)
        np.testing.assert_allclose(error, tangent, atol=1e-12)


def test_closed_form_refuses_a_residual_that_it_does_not_solve():
    _, T, found, weight = _match(3)
    with pytest.raises(TypeError, match="GaussNewton for PointToPlane"):
        ClosedForm()(T, found, weight, PointToPlane())
