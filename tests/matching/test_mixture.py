"""Densities of the mixture against quadrature."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from jaxreg.matching.mixture import _log_mean_of_power


@pytest.mark.parametrize("k", [4.0, 30.0, 200.0])
def test_directions_at_random_have_this_mean_power_of_a_cosine(k):
    for d, share in ((2, lambda x: 2 / np.pi), (3, np.sin)):
        mean, _ = quad(lambda x, share=share: share(x) * np.cos(x) ** k, 0, np.pi / 2)
        found = _log_mean_of_power(jnp.asarray(k), d)
        # In the plane two large logarithms of gamma functions are subtracted.
        np.testing.assert_allclose(found, np.log(mean), rtol=1e-4)
