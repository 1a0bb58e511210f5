"""Residuals against automatic differentiation and the matrices of their papers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion
from matches import N, found_at, noisy_problem

from jaxreg.local import GaussNewton, LocalOptimiser, turn_and_shift
from jaxreg.matching import (
    PlaneToPlane,
    PointToPlane,
    PointToPoint,
    Symmetric,
    match,
    moved,
)
from jaxreg.robust import GemanMcClure


EPSILON = 1 / 128
RESIDUALS = [PointToPoint(), PointToPlane(0.25), PlaneToPlane(EPSILON), Symmetric()]
by_residual = pytest.mark.parametrize(
    "residual", RESIDUALS, ids=lambda r: type(r).__name__
)
in_2d_and_3d = pytest.mark.parametrize("d", [2, 3])


def _gicp_metric(problem, T):
    """(C_q + R C_p R^T)^-1 of every point, by inversion in NumPy."""
    d = problem.source.shape[0]
    R = np.asarray(T)[:d, :d]
    q = np.asarray(problem.target[d:]).T
    p = np.asarray(problem.source_normals).T
    eye = np.eye(d)
    C_q = eye - (1 - EPSILON) * np.einsum("ni,nj->nij", q, q)
    C_p = eye - (1 - EPSILON) * np.einsum("ni,nj->nij", p, p)
    return np.linalg.inv(C_q + R @ C_p @ R.T)


def _stacked(residual, problem, T):
    """The residual vector of every point as a function of the tangent, `(n, r)`.

    Written from the papers, without the package's moments and lever arms.
    """
    d = problem.source.shape[0]
    q, n_q = problem.target[:d].T, problem.target[d:].T
    p, n_p = problem.source.T, problem.source_normals.T
    root = jnp.linalg.cholesky(jnp.asarray(_gicp_metric(problem, T)))
    sign = jnp.sign(jnp.sum((n_p @ T[:d, :d].T) * n_q, axis=1, keepdims=True))

    def residuals(tangent):
        T_new = turn_and_shift(T, tangent)
        R, t = T_new[:d, :d], T_new[:d, d]
        r = q - (p @ R.T + t)
        if isinstance(residual, PointToPoint):
            return r
        if isinstance(residual, PointToPlane):
            plane = jnp.sum(n_q * r, axis=1, keepdims=True)
            return jnp.concatenate([plane, 0.5 * r], axis=1)
        if isinstance(residual, PlaneToPlane):
            return jnp.einsum("nij,ni->nj", root, r)
        return jnp.sum((sign * n_p @ R.T + n_q) * r, axis=1, keepdims=True)

    return residuals


@by_residual
@in_2d_and_3d
def test_normal_equations_are_those_of_the_linearised_residual(d, residual):
    with jax.enable_x64(True):
        problem, T, weight = noisy_problem(d)
        residuals = _stacked(residual, problem, T)
        zero = jnp.zeros(3 if d == 2 else 6)

        @jax.jit
        def both(weight):
            found = match(problem, T)
            H, b = residual.normal_equations(found, weight)
            slope = jax.grad(
                lambda v: residual.energy(moved(found, T, turn_and_shift(T, v)), weight)
            )(zero)
            r = residuals(zero)
            J = -jax.jacfwd(residuals)(zero)
            return (
                (H, jnp.einsum("n,nri,nrj->ij", weight, J, J)),
                (b, jnp.einsum("n,nri,nr->i", weight, J, r)),
                (residual.descents(found) @ weight, b),
                (b, -slope),
                (
                    residual.energy(found, weight),
                    jnp.einsum("n,nr,nr->", weight, r, r) / 2,
                ),
            )

        for mine, expected in both(weight):
            np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-9)


def test_masked_points_have_no_weight():
    problem, T, _ = noisy_problem(3, np.float32)
    mask = jnp.arange(N) % 3 > 0
    masked = eqx.tree_at(lambda p: p.source_mask, problem, mask)
    for residual in (PointToPlane(), PointToPoint()):
        optimiser = LocalOptimiser(residual, GemanMcClure(), GaussNewton())
        weight = optimiser.weights(found_at(masked, T), jnp.asarray(0.3))
        np.testing.assert_array_equal(weight > 0, mask)


@in_2d_and_3d
def test_a_moved_match_is_the_match_of_the_other_pose(d):
    with jax.enable_x64(True):
        problem, T, _ = noisy_problem(d)
        T_new = jnp.asarray(motion(7, d))
        seen = jax.jit(moved)(found_at(problem, T), T, T_new)
        there = found_at(problem, T_new)
        np.testing.assert_allclose(seen.rotated, there.rotated, atol=1e-12)
        np.testing.assert_allclose(seen.residual, there.residual, atol=1e-12)
        turned = seen.turn @ seen.source_normal
        np.testing.assert_allclose(turned, there.source_normal, atol=1e-12)


@eqx.filter_jit
def _equations(residual, found, weight):
    return residual.normal_equations(found, weight)


@eqx.filter_jit
def _energy(residual, found, weight):
    return residual.energy(found, weight)


@pytest.mark.parametrize("residual", [PlaneToPlane(), Symmetric(), PointToPlane()])
def test_signs_of_normals_do_not_matter(residual):
    problem, T, weight = noisy_problem(3, np.float32)
    found = found_at(problem, T)
    flip = jnp.asarray(np.where(np.arange(N) % 2, 1, -1), jnp.float32)
    flipped = eqx.tree_at(lambda m: m.source_normal, found, flip * found.source_normal)
    flipped = eqx.tree_at(lambda m: m.normal, flipped, flip[::-1] * found.normal)
    for one, other in zip(
        _equations(residual, found, weight),
        _equations(residual, flipped, weight),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-3)


def test_plane_to_plane_without_normals_is_half_of_point_to_point():
    problem, T, weight = noisy_problem(3, np.float32)
    found = found_at(problem, T)
    bare = eqx.tree_at(
        lambda m: (m.normal, m.source_normal), found, replace_fn=jnp.zeros_like
    )
    for mine, points in zip(
        _equations(PlaneToPlane(), bare, weight),
        _equations(PointToPoint(), bare, weight),
        strict=True,
    ):
        np.testing.assert_allclose(mine, points / 2, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("bare", ["normal", "source_normal"])
def test_plane_to_plane_takes_a_missing_normal_from_the_other_surface(bare):
    problem, T, weight = noisy_problem(3, np.float32)
    found = found_at(problem, T)
    other = found.source_normal if bare == "normal" else found.normal
    missing, same = (
        eqx.tree_at(lambda m: getattr(m, bare), found, x)
        for x in (jnp.zeros_like(other), other)
    )
    for mine, wanted in zip(
        _equations(PlaneToPlane(), missing, weight),
        _equations(PlaneToPlane(), same, weight),
        strict=True,
    ):
        np.testing.assert_allclose(mine, wanted, rtol=1e-5, atol=1e-5)


def test_the_symmetric_residual_vanishes_for_two_points_of_one_circle():
    angle = np.linspace(0.1, 1.5, N)
    p = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    q = np.stack([np.cos(angle + 0.4), np.sin(angle + 0.4)], axis=1)
    problem, T, weight = noisy_problem(2, np.float32)
    found = found_at(problem, T)
    p, q = (jnp.asarray(x.T, jnp.float32) for x in (p, q))
    found = eqx.tree_at(
        lambda m: (m.source, m.R, m.residual, m.source_normal, m.normal),
        found,
        (p, jnp.eye(2, dtype=p.dtype), q - p, p, q),
    )
    assert float(_energy(Symmetric(), found, weight)) < 1e-10
    assert float(_energy(PointToPlane(0.0), found, weight)) > 1e-2
