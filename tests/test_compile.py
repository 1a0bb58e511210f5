"""`compiled` works wherever `jit` does, and where XLA has lost its option."""

import jax
import jax.numpy as jnp
import pytest

from jaxreg._core import compile as compile_module
from jaxreg._core.compile import compiled


@compiled
def scaled(x: jax.Array, by: float = 2.0) -> jax.Array:
    return by * jnp.sin(x)


def twice_sine(x: jax.Array) -> jax.Array:
    return 2 * jnp.sin(x)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit, jax.vmap, jax.jacfwd])
def test_compiled_functions_stand_inside_any_transformation(wrap):
    x = jnp.linspace(0, 1, 5)
    assert jnp.allclose(wrap(scaled)(x), wrap(twice_sine)(x))


def test_compiled_functions_stand_where_only_the_surroundings_are_traced():
    found = jax.jit(lambda x: x + scaled(jnp.ones(2)))(jnp.ones(2))
    assert jnp.allclose(found, 1 + twice_sine(jnp.ones(2)))


def test_settings_are_static_and_keep_their_names():
    assert jnp.allclose(scaled(jnp.ones(2), by=3.0), 3 * jnp.sin(1.0))


def test_an_option_that_this_compiler_lacks_is_left_out(monkeypatch):
    monkeypatch.setattr(compile_module, "_QUICKER", {"xla_cpu_no_such_option": True})
    compile_module._known.cache_clear()
    try:
        assert jnp.allclose(compiled(twice_sine)(jnp.ones(2)), twice_sine(jnp.ones(2)))
    finally:
        compile_module._known.cache_clear()
