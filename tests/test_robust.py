"""Every kernel against its definition."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.robust import (
    L1,
    L2,
    Cauchy,
    GemanMcClure,
    Huber,
    Trimmed,
    Tukey,
    Welsch,
)


WIDTH = 0.7
DEFINITION = {  # rho(r), written independently of the implementation
    L2: lambda r, c: r**2 / 2,
    L1: lambda r, c: np.sqrt(r**2 + c**2) - c,
    Huber: lambda r, c: np.where(r <= c, r**2 / 2, c * (r - c / 2)),
    Cauchy: lambda r, c: c**2 / 2 * np.log(1 + (r / c) ** 2),
    GemanMcClure: lambda r, c: r**2 / 2 / (1 + (r / c) ** 2),
    Tukey: lambda r, c: c**2 / 6 * np.where(r <= c, 1 - (1 - (r / c) ** 2) ** 3, 1.0),
    Welsch: lambda r, c: c**2 * (1 - np.exp(-(r**2) / (2 * c**2))),
    Trimmed: lambda r, c: np.minimum(r, c) ** 2 / 2,
}
LIMIT = {  # rho at infinity over the squared width
    GemanMcClure: 1 / 2,
    Tukey: 1 / 6,
    Welsch: 1,
    Trimmed: 1 / 2,
}
KERNELS = [kernel() for kernel in DEFINITION]
# Two of them lie on either side of the width, where Huber, Tukey, Trimmed bend.
NORMS = np.concatenate([np.linspace(0.01, 5, 38), [0.69, 0.71]])
by_kernel = pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)


@eqx.filter_jit
def _evaluate(kernel, norm, width):
    """rho, weight, and the derivative of rho, of 40 norms at a time."""
    rho, pull = jax.jvp(
        lambda r: kernel.rho(r * r, width), (norm,), (jnp.ones_like(norm),)
    )
    return rho, kernel.weight(norm * norm, width), pull


def _at(kernel, norm, width, dtype: type = np.float32):
    """The same in NumPy, for up to 40 norms."""
    norm = np.asarray(norm, dtype)
    padded = jnp.asarray(np.resize(norm, 40))
    out = _evaluate(kernel, padded, jnp.asarray(width, dtype))
    return [np.asarray(x)[: len(norm)] for x in out]


@eqx.filter_jit
def _width_of(kernel, sq, mask):
    return kernel.width_of(sq, mask)


@by_kernel
def test_rho_is_the_definition_and_weight_its_derivative_over_r(kernel):
    with jax.enable_x64(True):
        found, weight, pull = _at(kernel, NORMS, WIDTH, np.float64)
        rho = DEFINITION[type(kernel)]
        np.testing.assert_allclose(found, rho(NORMS, WIDTH), rtol=1e-12)
        h = 1e-6
        difference = (rho(NORMS + h, WIDTH) - rho(NORMS - h, WIDTH)) / (2 * h)
        np.testing.assert_allclose(weight, difference / NORMS, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(weight, pull / NORMS, rtol=1e-10, atol=1e-14)


@by_kernel
def test_limits(kernel):
    rho, weight, pull = _at(kernel, [1e-3, 1e4, 1e5], WIDTH)
    curvature = 1 / WIDTH if isinstance(kernel, L1) else 1
    assert rho[0] == pytest.approx(curvature * 5e-7, rel=1e-4)
    assert weight[0] == pytest.approx(curvature, rel=1e-4)
    if type(kernel) in LIMIT:
        assert rho[2] == pytest.approx(LIMIT[type(kernel)] * WIDTH**2, rel=1e-4)
    if isinstance(kernel, (L1, L2, Huber)):  # not redescending
        assert pull[2] >= 0.99 * pull[1]
    else:
        assert pull[2] <= 0.2 * pull[1]


@by_kernel
def test_nothing_is_nan_at_zero_and_huge_residuals(kernel):
    for width in (0.0, 1e-12, 0.7, 1e12):
        rho, weight, pull = _at(kernel, [0.0, 1e-19, 1.0, 1e15], width)
        assert np.all(np.isfinite(weight))
        assert not np.any(np.isnan(rho))
        assert pull[0] == 0


@by_kernel
def test_width_follows_the_residuals(kernel):
    rng = np.random.default_rng(0)
    norms = np.abs(rng.standard_normal(99)).astype(np.float32)
    mask = rng.random(99) < 0.8
    width = _width_of(kernel, jnp.asarray(norms**2), jnp.asarray(mask))
    share, factor = (0.7, 1) if isinstance(kernel, Trimmed) else (1 / 3, 1.5)
    expected = factor * np.quantile(norms[mask], share, method="inverted_cdf")
    assert width.dtype == jnp.float32
    assert float(width) == pytest.approx(expected, rel=1e-6)
    scaled = _width_of(kernel, jnp.asarray(1e6 * norms**2), jnp.asarray(mask))
    assert float(scaled) == pytest.approx(1e3 * expected, rel=1e-5)
    assert float(_width_of(kernel, jnp.asarray(norms), jnp.zeros(99, bool))) == 0


@pytest.mark.parametrize("share", [0.25, 0.7, 1.0])
def test_trimmed_keeps_its_share(share):
    kernel = Trimmed(share)
    norms = np.random.default_rng(0).gamma(0.5, size=40).astype(np.float32)
    width = kernel.width_of(jnp.asarray(norms**2), jnp.ones(40, bool))
    assert np.sum(_at(kernel, norms, width)[1]) == round(40 * share)
