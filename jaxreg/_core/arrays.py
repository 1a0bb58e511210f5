"""Fields of method objects: traced numbers, static structure."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


Tree = TypeVar("Tree")


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
