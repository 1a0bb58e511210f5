"""Loops and branches that also run inside `jax.shard_map`.

There the type of an array says over which axes of devices it varies, and what a loop
carries, or branches return, must have one type: a zero, the same on all devices, may
not become a sum over points that are not. These are those of `jax.lax`, which they are
outside of `shard_map`; inside, what is carried is given the type that it will have.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


Tree = TypeVar("Tree")
Args = ParamSpec("Args")
In = TypeVar("In")
Out = TypeVar("Out")

#: The axes over which the inputs of the function that is traced vary, if it told them.
_AXES: ContextVar[tuple[str, ...] | None] = ContextVar("axes", default=None)


def over_devices(function: Callable[Args, Out]) -> Callable[Args, Out]:
    """Whose loops carry what varies over the axes of its inputs, and no others."""

    @functools.wraps(function)
    def traced(*args: Args.args, **kwargs: Args.kwargs) -> Out:
        if not _manual_axes():
            return function(*args, **kwargs)
        leaves = [x for x in jax.tree.leaves((args, kwargs)) if eqx.is_array(x)]
        axes = frozenset[str]().union(*map(_varies_over, leaves))
        with _carrying(tuple(sorted(axes))):
            args, kwargs = varying((args, kwargs))
            return function(*args, **kwargs)

    return traced


def varying(tree: Tree) -> Tree:
    """The same numbers, of the type of what differs from device to device."""
    axes = _AXES.get()
    axes = _manual_axes() if axes is None else axes
    if not axes or not _types_are_checked():
        return tree
    differs = _cast(jnp.zeros((), bool), axes)

    def of(x: Any) -> Any:
        if not (eqx.is_array(x) or isinstance(x, int | float)):
            return x
        x = jnp.asarray(x)
        # A choice between equals: another cast would fail where `vmap` made one.
        return lax.select(jnp.broadcast_to(differs, x.shape), x, x)

    return jax.tree.map(of, tree)


def while_loop(
    unfinished: Callable[[Tree], Array], body: Callable[[Tree], Tree], start: Tree
) -> Tree:
    """`lax.while_loop`."""
    if not _manual_axes():
        return lax.while_loop(unfinished, body, start)
    return lax.while_loop(unfinished, _typed(body), varying(start))


def fori_loop(
    lower: Any, upper: Any, body: Callable[[Any, Tree], Tree], start: Tree, **how: Any
) -> Tree:
    """`lax.fori_loop`."""
    if not _manual_axes():
        return lax.fori_loop(lower, upper, body, start, **how)
    return lax.fori_loop(lower, upper, _typed(body), varying(start), **how)


def grouped_map(function: Callable[[In], Out], rows: In, most: int) -> Out:
    """`jax.lax.map`, so many rows side by side as divide all, at most `most`.

    Groups of one size: what is left over would be a program of its own.
    """
    num = len(jax.tree.leaves(rows)[0])
    group = max(k for k in range(1, most + 1) if num % k == 0)
    return lax.map(function, rows, batch_size=group)


def scan(
    body: Callable[[Any, Any], tuple[Any, Any]],
    start: Any,
    rows: Any = None,
    length: int | None = None,
) -> tuple[Any, Any]:
    """`lax.scan`."""
    if not _manual_axes():
        return lax.scan(body, start, rows, length)
    return lax.scan(_typed(body), varying(start), rows, length)


def cond(
    which: Any, then: Callable[..., Out], other: Callable[..., Out], *operands: Any
) -> Out:
    """`lax.cond`; where types are checked a choice between both, as under `vmap`.

    Of a `lax.cond` under both, `vmap` makes operands vary that the branches, which were
    traced before, cast once more, and that raises: constants, too.
    """
    if not _types_are_checked():
        return lax.cond(which, then, other, *operands)
    both = varying((then(*operands), other(*operands)))
    return jax.tree.map(
        lambda x, y: lax.select(jnp.broadcast_to(which, x.shape), x, y), *both
    )


def _typed(function: Callable[Args, Out]) -> Callable[Args, Out]:
    def typed(*args: Args.args, **kwargs: Args.kwargs) -> Out:
        return varying(function(*args, **kwargs))

    return typed


def inside_shard_map() -> bool:
    """Whether what is traced runs on each of several devices by itself."""
    return bool(_manual_axes())


def _manual_axes() -> tuple[str, ...]:
    """The axes of `shard_map` around this; nothing outside of it."""
    return tuple(jax.sharding.get_abstract_mesh().manual_axes)


def _types_are_checked() -> bool:
    """Inside `shard_map`, but not with `check_vma=False`."""
    axes = _manual_axes()
    return bool(axes and _varies_over(_cast(jnp.zeros((), bool), axes)))


def _varies_over(x: Any) -> frozenset[str]:
    kind = jax.typeof(x)
    kind = getattr(kind, "mat", None) or kind  # from JAX 0.10 on
    return getattr(kind, "varying", None) or getattr(kind, "vma", None) or frozenset()


def _cast(x: Array, axes: tuple[str, ...]) -> Array:
    if hasattr(lax, "pcast"):  # from JAX 0.8 on
        return lax.pcast(x, axes, to="varying")
    return lax.pvary(x, axes)  # pyright: ignore[reportAttributeAccessIssue]


@contextmanager
def _carrying(axes: tuple[str, ...]) -> Iterator[None]:
    before = _AXES.set(axes)
    try:
        yield
    finally:
        _AXES.reset(before)
