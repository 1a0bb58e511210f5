import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.robust import L1, L2, Correntropy, GemanMcClure


KERNELS = [L2(), L1(), GemanMcClure(), Correntropy()]
R = jnp.linspace(0.01, 5, 40)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_weight_is_the_derivative_of_rho_over_r(kernel):
    with jax.enable_x64(True):
        width = jnp.asarray(0.7)
        r = jnp.linspace(0.01, 5, 40)
        slope = jax.vmap(jax.grad(lambda x: kernel.rho(x**2, width)))(r)
        np.testing.assert_allclose(kernel.weight(r**2, width), slope / r, rtol=1e-5)


@pytest.mark.parametrize("kernel", [GemanMcClure(), Correntropy()])
def test_redescending_kernels_are_bounded_and_quadratic_near_zero(kernel):
    width = jnp.asarray(0.7)
    bound = {GemanMcClure: 0.5, Correntropy: 1.0}[type(kernel)] * 0.7**2
    assert float(kernel.rho(jnp.asarray(1e6), width)) == pytest.approx(bound, rel=1e-3)
    assert float(kernel.rho(jnp.asarray(1e-6), width)) == pytest.approx(5e-7, rel=1e-3)
    assert np.all(np.diff(kernel.weight(R**2, width)) < 0)


def test_definitions():
    width = jnp.asarray(2.0)
    nine = jnp.asarray(9.0)
    assert float(L2().rho(nine, width)) == 4.5
    assert float(L1().rho(nine, width)) == pytest.approx(np.sqrt(13) - 2)
    assert float(GemanMcClure().rho(nine, width)) == pytest.approx(4.5 / 3.25)
    assert float(Correntropy().rho(nine, width)) == pytest.approx(
        4 * (1 - np.exp(-9 / 8))
    )
