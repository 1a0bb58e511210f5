"""Fields of method objects: traced numbers, static structure."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


Tree = TypeVar("Tree")
Out = TypeVar("Out")


def traced(default: float) -> Any:
    """A float field held as an array, so that changing it does not recompile."""
    return eqx.field(default=default, converter=_as_scalar)


def _as_scalar(x: float | Array) -> Array:
    return jnp.asarray(x, dtype=jnp.result_type(float)) if _is_number(x) else x  # pyright: ignore[reportReturnType]


def _is_number(x: object) -> bool:
    return isinstance(x, (int, float))


def cast_floats(tree: Tree, dtype: Any) -> Tree:
    """Casts every floating array of a pytree, so that no setting promotes the data."""

    def cast(x: Any) -> Any:
        if eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating):
            return x.astype(dtype)
        return x

    return jax.tree.map(cast, tree)


def on_both(function: Callable[[Tree], Out], a: Tree, b: Tree) -> tuple[Out, Out]:
    """`function` of either tree; of arrays of the same shapes it is compiled once."""
    first, second = (jax.tree.map(jax.typeof, tree) for tree in (a, b))
    if first != second:
        return function(a), function(b)
    out = lax.map(function, jax.tree.map(lambda *x: jnp.stack(x), a, b))
    return jax.tree.map(lambda x: x[0], out), jax.tree.map(lambda x: x[1], out)
