import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxreg.geometry import lie


def _hat(v: np.ndarray) -> np.ndarray:
    if len(v) == 3:
        return np.array([[0, -v[2], v[0]], [v[2], 0, v[1]], [0, 0, 0]])
    x, y, z, a, b, c = v
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


tangents_3 = hnp.arrays(np.float64, 3, elements=st.floats(-1.5, 1.5))
tangents_6 = hnp.arrays(np.float64, 6, elements=st.floats(-1.5, 1.5))


@jax.jit
def _there_and_back(v):
    T = lie.exp(v)
    return T, lie.log(T), lie.inverse(T) @ T


@settings(max_examples=30, deadline=None)
@given(v=st.one_of(tangents_3, tangents_6))
@example(v=np.array([1, 0.3, 1e-8]))
@example(v=np.array([1, 0.3, 0.2, 1e-6, 0, 1e-6]))
@example(v=np.array([1, 0.3, 0.2, 0.03, 0, 0.001]))
# Just below the angle at which series take over, far enough to see their last terms.
@example(v=np.array([30, 10, 0.0299]))
@example(v=np.array([30, 10, 20, 0.029, 0.001, 0.005]))
def test_exp_is_the_matrix_exponential_translation_first(v):
    with jax.enable_x64(True):
        T, again, left = _there_and_back(jnp.asarray(v))
    np.testing.assert_allclose(T, expm(_hat(v)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(again, v, rtol=0, atol=1e-9)
    np.testing.assert_allclose(left, np.eye(len(T)), atol=1e-12)


@jax.jit
def _moved_after_and_before(v, w):
    T = lie.exp(v)
    return lie.exp(lie.adjoint(T) @ w), T @ lie.exp(w) @ lie.inverse(T)


@settings(max_examples=20, deadline=None)
@given(both=st.one_of(*(st.tuples(x, x) for x in (tangents_3, tangents_6))))
def test_adjoint_moves_a_tangent_through_a_motion(both):
    v, w = both
    with jax.enable_x64(True):
        left, right = _moved_after_and_before(v, 0.1 * w)
    np.testing.assert_allclose(left, right, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_in_is_dtype_out_under_strict_promotion(d, dtype):
    def all_of(v, points):
        T = lie.exp(v)
        return T, lie.log(T), lie.inverse(T), lie.act(T, points)

    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        v = np.full(lie.tangent_dim(d), 0.3, dtype)
        out = jax.eval_shape(all_of, v, np.ones((5, d), dtype))
        assert {x.dtype for x in out} == {np.dtype(dtype)}


@pytest.mark.parametrize("d", [2, 3])
def test_log_has_finite_gradients_at_the_identity(d):
    jacobian = jax.jit(jax.jacobian(lambda v: lie.log(lie.exp(v))))
    grad = jacobian(np.zeros(lie.tangent_dim(d), np.float32))
    np.testing.assert_allclose(grad, np.eye(lie.tangent_dim(d)), atol=1e-6)


_angle = jax.jit(lie.rotation_angle)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, 3.0, np.pi - 1e-4, np.pi])
def test_rotation_angle_is_accurate_near_zero_and_pi(angle):
    axis = np.array([1.0, 2.0, -2.0]) / 3
    R3 = Rotation.from_rotvec(angle * axis).as_matrix().astype(np.float32)
    c, s = np.cos(angle), np.sin(angle)
    R2 = np.array([[c, -s], [s, c]], np.float32)
    for R in (R2, R3):
        assert float(_angle(R)) == pytest.approx(angle, abs=2e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rotation_vectors_are_those_of_jaxlie(dtype):
    rng, eps = np.random.default_rng(0), np.finfo(dtype).eps
    axes = np.concatenate([rng.normal(size=(60, 3)), np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([[0, 1e-7, 1e-3, np.pi - 1e-3], np.linspace(0.1, 3.1, 9)])
    with jax.enable_x64(dtype is np.float64):
        turn = jax.jit(lambda R: (lie.rotation_log(R), jaxlie.SO3.from_matrix(R).log()))
        for angle in angles:
            R = Rotation.from_rotvec(angle * axes).as_matrix().astype(dtype)
            found, theirs = turn(jnp.asarray(R))
            assert found.dtype == dtype
            # Their digits near zero and a half turn are fewer.
            np.testing.assert_allclose(found, theirs, rtol=1e-4, atol=300 * eps)
            np.testing.assert_allclose(found, angle * axes, rtol=0, atol=8 * eps)
        half = Rotation.from_rotvec(np.pi * axes).as_matrix().astype(dtype)
        again = lie.rotation_exp(lie.rotation_log(jnp.asarray(half)))
        np.testing.assert_allclose(again, half, atol=16 * eps)
        flat = jnp.asarray([[[0, 1], [-1, 0]]], dtype)
        np.testing.assert_allclose(lie.rotation_log(flat), [[-np.pi / 2]], rtol=eps)


def test_orthonormalise_gives_the_nearest_rotation():
    rng = np.random.default_rng(0)
    R = Rotation.random(rng=rng).as_matrix()
    T = np.eye(4, dtype=np.float32)
    T[:3, :3] = R + 0.01 * rng.standard_normal((3, 3))
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = np.asarray(jax.jit(lie.orthonormalise)(T))
    np.testing.assert_allclose(out[:3, :3], U @ Vt, atol=1e-5)
    assert np.linalg.det(out[:3, :3]) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("d", [2, 3])
def test_straightened_is_the_nearest_rotation_to_second_order(d):
    rng = np.random.default_rng(d)
    T = np.tile(np.eye(d + 1), (20, 1, 1))
    T[:, :d, :d] = np.linalg.qr(rng.standard_normal((20, d, d)))[0]
    T[:, :d, 0] *= np.linalg.det(T)[:, None]
    T[:, :d] += 1e-4 * rng.standard_normal((20, d, d + 1))
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(lie.straightened)(T))
    U, _, Vt = np.linalg.svd(T[:, :d, :d])
    np.testing.assert_allclose(found[:, :d, :d], U @ Vt, atol=1e-7)
    assert np.max(np.abs(U @ Vt - T[:, :d, :d])) > 3e-5
    np.testing.assert_array_equal(found[:, :, d], T[:, :, d])


@pytest.mark.parametrize("d", [2, 3])
def test_orthonormalise_never_reflects(d):
    T = np.tile(np.eye(d + 1), (20, 1, 1))
    T[:, :d, :d] = np.random.default_rng(d).standard_normal((20, d, d))
    found = np.asarray(jax.jit(lie.orthonormalise)(T.astype(np.float32)))
    U, _, Vt = np.linalg.svd(T[:, :d, :d])
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    assert 0 < np.sum(np.linalg.det(T) < 0) < 20
    np.testing.assert_allclose(found[:, :d, :d], U @ Vt, atol=1e-4)


@pytest.mark.parametrize("d", [2, 3])
def test_random_rotations_are_rotations_and_uniform(d):
    draw = jax.jit(lambda key: lie.random_rotations(key, 4000, d, jnp.float32))
    R = np.asarray(draw(jax.random.key(0)))
    np.testing.assert_allclose(
        np.einsum("pij,pkj->pik", R, R), np.broadcast_to(np.eye(d), R.shape), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    # Uniform over SO(d): every column has mean zero and covariance I / d.
    np.testing.assert_allclose(R.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(np.cov(R[:, :, 0].T), np.eye(d) / d, atol=0.03)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("size", [0.029, 0.5, 2.5])
def test_log_jacobian_is_the_derivative_of_the_logarithm(d, size):
    v = np.random.default_rng(d).normal(size=lie.tangent_dim(d))
    v[d:] *= size / np.linalg.norm(v[d:])
    with jax.enable_x64(True):
        found, expected = _log_jacobians(v)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@jax.jit
def _log_jacobians(v):
    """Ours, and by differentiating."""
    T = lie.exp(v)
    by_jax = jax.jacfwd(lambda x: lie.log(T @ lie.exp(x)))(jnp.zeros_like(v))
    return lie.log_jacobian(v), by_jax
