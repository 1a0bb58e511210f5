"""Fields of method objects, traced numbers and static structure; rows of arrays."""

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.checks import TRACED
from jaxreg._core.platforms import by_platform


Tree = TypeVar("Tree")
Out = TypeVar("Out")


def traced(default: float | None) -> Any:
    """A float field held as an array, so that changing it does not recompile."""
    return eqx.field(default=default, converter=_as_scalar, metadata={TRACED: True})


def _as_scalar(x: float | Array | None) -> Array | None:
    if not _is_number(x):
        return x  # pyright: ignore[reportReturnType]
    try:
        # Put there in so many words, which every transfer guard allows.
        return jax.device_put(np.asarray(x, dtype=jnp.result_type(float)))
    except OverflowError:  # an integer of hundreds of digits: its check says so
        return x  # pyright: ignore[reportReturnType]


def _is_number(x: object) -> bool:
    numbers = int, float, np.integer, np.floating
    return isinstance(x, numbers) and not isinstance(x, bool)


def full_matmul(a: Float[Array, "i j"], b: Float[Array, "j l"]) -> Float[Array, "i l"]:
    """The matrix product; accelerators would round its factors to ten bits."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def weighted_sums(
    rows: Float[Array, "r n"], weight: Float[Array, " n"]
) -> Float[Array, " r"]:
    """Of each row, as one product: on a CPU it compiles in half the time of sums."""
    return full_matmul(rows, weight[:, None])[:, 0]


def cast_floats(tree: Tree, dtype: Any) -> Tree:
    """Casts every floating array of a pytree, so that no setting promotes the data."""

    def cast(x: Any) -> Any:
        if eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating):
            return x.astype(dtype)
        return x

    return jax.tree.map(cast, tree)


def widened(tree: Tree) -> Tree:
    """The numbers of concrete arrays in float64, which must be switched on."""

    def wide(x: Array) -> Array:
        floating = jnp.issubdtype(x.dtype, jnp.floating)
        return jnp.asarray(np.asarray(x), jnp.float64) if floating else x

    return jax.tree.map(wide, tree)


def on_both(function: Callable[[Tree], Out], a: Tree, b: Tree) -> tuple[Out, Out]:
    """`function` of either tree; of arrays of the same shapes it is compiled once."""
    first, second = (jax.tree.map(jax.typeof, tree) for tree in (a, b))
    if first != second:
        return function(a), function(b)
    out = lax.map(function, jax.tree.map(lambda *x: jnp.stack(x), a, b))
    return jax.tree.map(lambda x: x[0], out), jax.tree.map(lambda x: x[1], out)


def rows_of(x: Array, rows: Int[Array, "..."], axis: int = 0) -> Array:
    """Rows that are known to be there: `x[rows]` tests each for being negative."""
    return jnp.take(x, rows, axis=axis, mode="clip")


def spread_rows(
    mask: Bool[Array, " n"], num: int
) -> tuple[Int[Array, " r"], Bool[Array, " r"]]:
    """At most `num` valid rows, evenly spread, and which of them are in use.

    The same for any number of masked rows.
    """
    num = min(num, mask.shape[0])
    count = jnp.cumsum(mask.astype(jnp.int32))
    at, used = jnp.arange(num, dtype=jnp.int32), jnp.minimum(count[-1], num)
    # The valid row of that rank; searched, not sorted.
    rank = at * (count[-1] - 1) // jnp.maximum(used - 1, 1)
    row = place_among(count, rank + 1)
    return jnp.minimum(row, len(mask) - 1), at < used


def place_among(
    ascending: Array, wanted: Array, side: Literal["left", "right"] = "left"
) -> Array:
    """`jnp.searchsorted`: by halves on a CPU, by one sort on an accelerator."""

    def by_sort() -> Array:
        place = jnp.searchsorted(ascending, wanted, side=side, method="sort")
        return place.astype(jnp.int32)

    return by_platform(lambda: _place_by_halves(ascending, wanted, side), by_sort)


def _place_by_halves(ascending: Array, wanted: Array, side: str) -> Array:
    """How many are less, bit by bit; JAX's own takes 1.7 times as long to compile."""
    num = len(ascending)

    def with_bit(k: Array, place: Array) -> Array:
        trial = place + (1 << (bits - 1 - k))
        last = rows_of(ascending, trial - 1)
        less = last < wanted if side == "left" else last <= wanted
        return jnp.where((trial <= num) & less, trial, place)

    bits = num.bit_length()
    start = jnp.zeros(wanted.shape, jnp.int32)
    return control.fori_loop(0, bits, with_bit, start)
