"""What is chosen by the platform, without having another than a CPU."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.platforms import by_platform, platform_of, traced_for
from jaxreg._core.programs import kept_program
from jaxreg.batching.side_by_side import side_by_side


def _which() -> jax.Array:
    return by_platform(lambda: jnp.asarray(1), lambda: jnp.asarray(2))


def test_what_runs_on_a_cpu_is_what_is_for_one():
    assert _which() == 1
    assert jax.jit(_which)() == 1
    assert jax.jit(jax.vmap(lambda x: x * _which()))(np.ones(3)).sum() == 3
    with traced_for("gpu"):
        assert _which() == 2


def test_the_platform_is_known_where_arrays_are():
    device = jax.devices()[0]
    assert platform_of(np.ones(3), jax.device_put(np.ones(3), device)) == "cpu"
    seen = []
    jax.jit(lambda x: seen.append(platform_of(x)) or x)(np.ones(3))
    assert seen == [None]


def test_a_program_knows_its_platform_and_multiplies_in_full_precision():
    seen = []

    @kept_program
    def product(x):
        seen.append(platform_of(x))
        return x @ x

    x = np.eye(3, dtype=np.float32)
    product(x)
    assert seen == ["cpu"]
    assert "HIGHEST" in str(jax.make_jaxpr(product)(x))
    assert seen == ["cpu", None]


def test_an_accelerator_takes_a_million_rows_at_once_and_a_cpu_one_problem():
    assert side_by_side(None, 4096, np.ones(3)) == 1
    assert side_by_side(7, 4096, np.ones(3)) == 7
    with traced_for("gpu"):
        assert side_by_side(None, 4096) == 256
        assert side_by_side(None, 1 << 22) == 1
