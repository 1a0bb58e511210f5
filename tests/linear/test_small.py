"""Small matrices against LAPACK in float64, one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxreg.linear import small


def _symmetric(n: int, seed: int, num: int = 24) -> np.ndarray:
    """Random ones, of every rank and scale; zero, the identity, and repeated values."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(num, n, n))
    A = A + A.swapaxes(1, 2)
    for k in range(4):
        half = A[k][:, : max(1, n - 1 - k)]
        A[k] = half @ half.T
    A[4], A[5], A[6] = 0, np.eye(n), np.diag([1.0] * (n - 1) + [2.0])
    A[7] *= 1e12
    A[8] *= 1e-12
    return A


eigh = jax.jit(small.eigh)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("n", [3, 6])
@pytest.mark.parametrize(("dtype", "tol"), [(np.float64, 1e-12), (np.float32, 5e-6)])
def test_eigenvectors_rebuild_the_matrix(n, dtype, tol, seed):
    A = _symmetric(n, seed).astype(dtype)
    with jax.enable_x64(True):
        value, vector = (np.asarray(x, np.float64) for x in eigh(jnp.asarray(A)))
    assert (np.diff(value, axis=1) >= 0).all()
    A = A.astype(np.float64)
    size = np.abs(A).max(axis=(1, 2))[:, None] + 1e-300
    expected = np.linalg.eigvalsh(A)
    np.testing.assert_allclose(value / size, expected / size, atol=tol)
    rebuilt = np.einsum("bij,bj,bkj->bik", vector, value, vector)
    np.testing.assert_allclose(rebuilt / size[..., None], A / size[..., None], atol=tol)
    gram = vector.swapaxes(1, 2) @ vector
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(n), A.shape), atol=tol)


def test_slopes_of_eigenvalues_and_of_projections():
    with jax.enable_x64(True):
        A = jnp.asarray(_symmetric(4, 0)[10])
        check_grads(lambda A: small.eigh(jnp.asarray(A + A.T))[0], (A,), 1, rtol=1e-5)

        def projected(A):
            vector = small.eigh(jnp.asarray(A + A.T))[1][:, :2]
            return vector @ vector.T

        check_grads(projected, (A,), 1, rtol=1e-5)
        # Of equal eigenvalues, too, whatever turn their eigenvectors have.
        slope = jax.grad(lambda A: jnp.sum(small.eigh(A)[0]))(jnp.eye(4))
        np.testing.assert_allclose(slope, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("n", [2, 3])
def test_inverses_by_cofactors(n):
    with jax.enable_x64(True):
        A = np.random.default_rng(n).normal(size=(50, n, n))
        np.testing.assert_allclose(
            small.inverse(jnp.asarray(A)) @ A,
            np.broadcast_to(np.eye(n), A.shape),
            atol=1e-10,
        )


@pytest.mark.parametrize("k", [1, 3, 6])
def test_semidefinite_systems_where_they_are_held(k):
    rng = np.random.default_rng(k)
    root = rng.normal(size=(20, k, k + 2))
    A, x = root @ root.swapaxes(1, 2), rng.normal(size=(20, k))
    # A direction that nothing holds: the last axis of half of them.
    A[10:, -1], A[10:, :, -1], x[10:, -1] = 0, 0, 0
    b = np.einsum("bij,bj->bi", A, x)
    with jax.enable_x64(True):
        found = small.solve_semidefinite(jnp.asarray(A), jnp.asarray(b))
        np.testing.assert_allclose(found, x, atol=1e-8)
        inverse = np.asarray(small.inverse_semidefinite(jnp.asarray(A)))
    np.testing.assert_allclose(inverse, np.linalg.pinv(A), atol=1e-7)


def test_least_norm_solutions_are_those_of_the_pseudoinverse():
    rng = np.random.default_rng(0)
    solve = jax.jit(jax.vmap(lambda A, b: small.least_norm_solution(A, b, 1e-10)))
    A, b = rng.normal(size=(12, 6, 6)), rng.normal(size=(12, 6))
    A[:6] = A[:6, :, :4] @ A[:6, :4, :]  # of rank four
    with jax.enable_x64(True):
        x = solve(jnp.asarray(A), jnp.asarray(b))
    expected = np.einsum("bij,bj->bi", np.linalg.pinv(A, rcond=1e-10), b)
    np.testing.assert_allclose(x, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_direction_that_is_free_up_to_rounding_gets_nothing(dtype):
    rng = np.random.default_rng(0)
    root, x = rng.normal(size=(50, 6, 5)), rng.normal(size=(50, 6))
    A = (root @ root.swapaxes(1, 2)).astype(dtype)  # of rank five
    with jax.enable_x64(True):
        b = np.einsum("bij,bj->bi", A, x).astype(dtype)
        found = np.asarray(small.solve_semidefinite(jnp.asarray(A), jnp.asarray(b)))
    # Rounding grows with the condition of the rest: a few pivots stand out of it.
    assert np.mean(found[:, -1] == 0) > 0.8
    left = np.einsum("bij,bj->bi", A, found) - b
    assert np.abs(left).max() < 1e5 * np.finfo(dtype).eps


@pytest.mark.parametrize("rank", [6, 4, 0])
def test_roots_of_normal_equations_have_their_product_and_pull(rank):
    rng = np.random.default_rng(rank)
    rows, r = rng.normal(size=(3, rank, 6)), rng.normal(size=(3, rank))
    A = np.einsum("bri,brj->bij", rows, rows)
    b = np.einsum("bri,br->bi", rows, r)
    with jax.enable_x64(True):
        R, root = map(np.asarray, small.root_semidefinite(jnp.array(A), jnp.array(b)))
    np.testing.assert_allclose(R.swapaxes(1, 2) @ R, A, atol=1e-10)
    np.testing.assert_allclose(np.einsum("bij,bi->bj", R, root), b, atol=1e-10)
    # No more of the sum of squares than the rows had.
    assert np.all(np.sum(root**2, axis=1) <= np.sum(r**2, axis=1) + 1e-10)
    assert np.sum(np.diagonal(R, axis1=1, axis2=2) > 1e-6) == 3 * rank
