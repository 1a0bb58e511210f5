"""Least eigenvectors against LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.geometry.eigen import least_eigenvectors


def _matrices(d: int) -> np.ndarray:
    """Spreads of points: any, along the axes, of planes, of nearly a line."""
    rng = np.random.default_rng(d)
    x = rng.standard_normal((90, 20, d))
    x[30:60] *= np.array([[3.0, 2.0, 1e-3], [1e-3, 2.0, 3.0], [2.0, 1e-3, 3.0]])[
        rng.integers(0, 3, 30), :d
    ][:, None]
    x[60:] = 0.02 * x[60:] + x[60:, :, :1] * rng.standard_normal((30, 1, d))
    out = np.einsum("nki,nkj->nij", x, x)
    out[:3] *= np.eye(d)  # two of the three cross products vanish
    return out


@pytest.mark.parametrize("d", [2, 3])
def test_least_eigenvectors_are_those_of_lapack(d):
    matrices = _matrices(d)
    entries = jnp.asarray(np.moveaxis(matrices, 0, -1), jnp.float32)
    vector, second, largest = jax.jit(least_eigenvectors)(entries)
    values, vectors = np.linalg.eigh(matrices)
    np.testing.assert_allclose(largest, values[:, -1], rtol=1e-5)
    top = values[:, -1]
    np.testing.assert_allclose(second / top, values[:, 1] / top, atol=2e-4)
    apart = values[:, 1] - values[:, 0] > 1e-2 * top
    assert np.sum(apart) > 50
    np.testing.assert_allclose(np.linalg.norm(vector, axis=0)[apart], 1, atol=1e-5)
    cosine = np.sum(np.asarray(vector).T * vectors[:, :, 0], axis=1)
    np.testing.assert_allclose(np.abs(cosine)[apart], 1, atol=1e-4)
