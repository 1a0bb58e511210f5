import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg.geometry.kabsch import kabsch
from jaxreg.geometry.nearest_rotation import nearest_rotation


N = 12
_kabsch = jax.jit(kabsch)
_turned = jax.jit(lambda M, dM: jax.jvp(nearest_rotation, (M,), (dM,)))


def _problem(seed: int, noise: float):
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((N, 3))
    R = Rotation.random(rng=rng).as_matrix()
    t = rng.standard_normal(3)
    target = source @ R.T + t + noise * rng.standard_normal((N, 3))
    return source, target, rng.uniform(0.1, 1, N), R, t


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_agrees_with_scipy_on_weighted_points(seed):
    with jax.enable_x64(True):
        source, target, weight, _, _ = _problem(seed, 0.3)
        T = np.asarray(_kabsch(source, target, weight))
        ms, mt = (np.average(x, axis=0, weights=weight) for x in (source, target))
        R = Rotation.align_vectors(target - mt, source - ms, weight)[0]
        np.testing.assert_allclose(T[:3, :3], R.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(T[:3, 3], mt - R.as_matrix() @ ms, atol=1e-9)


def test_never_returns_a_reflection():
    source = np.random.default_rng(0).standard_normal((N, 3)).astype(np.float32)
    T = _kabsch(source, source * np.array([1, 1, -1], np.float32))
    assert np.linalg.det(np.asarray(T)[:3, :3]) == pytest.approx(1, abs=1e-5)


def test_zero_weights_give_the_identity():
    source, target, weight = np.ones((N, 2)), np.zeros((N, 2)), np.zeros(N)
    np.testing.assert_array_equal(_kabsch(source, target, weight), np.eye(3))


def test_gradient_agrees_with_central_differences():
    with jax.enable_x64(True):
        source, target, weight, _, _ = _problem(3, 0.2)
        check_grads(
            _kabsch, (source, target, weight), order=1, modes=("fwd", "rev"), rtol=1e-5
        )


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_gradient_is_finite_where_singular_values_coincide(scale):
    # An octahedron has three equal singular values; scale 0 leaves none at all.
    octahedron = scale * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    target = jnp.asarray(octahedron)

    def cost(p):
        return jnp.sum(kabsch(p, target)[:3] * jnp.arange(12.0).reshape(3, 4))

    assert np.all(np.isfinite(jax.jit(jax.grad(cost))(octahedron)))


def test_derivative_at_coinciding_singular_values_is_the_true_one():
    with jax.enable_x64(True):
        # R(M) at M = I: dR is the skew part of dM.
        dM = np.random.default_rng(0).standard_normal((3, 3))
        _, dR = _turned(np.eye(3), dM)
        np.testing.assert_allclose(dR, (dM - dM.T) / 2, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_derivative_is_that_of_differences_on_both_sides_of_a_reflection(seed):
    rng = np.random.default_rng(seed)
    M, dM = rng.standard_normal((2, 3, 3))
    M[0] *= (-1) ** seed * np.sign(np.linalg.det(M))

    def rotation(M: np.ndarray) -> np.ndarray:
        U, _, Vt = np.linalg.svd(M)
        return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt

    with jax.enable_x64(True):
        R, dR = _turned(M, dM)
    np.testing.assert_allclose(R, rotation(M), atol=1e-12)
    difference = (rotation(M + 1e-6 * dM) - rotation(M - 1e-6 * dM)) / 2e-6
    np.testing.assert_allclose(dR, difference, rtol=1e-5, atol=1e-6)
