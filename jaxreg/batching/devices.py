"""Rows of a batch over the devices of a mesh: JAX's own, each alone with its rows.

No device hears of another: there is no collective.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from jaxreg._core.checks import is_concrete


#: The axis of a mesh over which pairs, and graphs, are spread.
PAIRS = "pair"

Tree = TypeVar("Tree")
Out = TypeVar("Out")


class Devices(NamedTuple):
    """Axes of a mesh, over which the leading axis of arrays is spread."""

    mesh: Mesh | AbstractMesh
    axes: tuple[str, ...]

    @property
    def size(self) -> int:
        """Parts that rows come in."""
        return int(np.prod([self.mesh.shape[axis] for axis in self.axes]))


def chosen_devices(mesh: object, *arrays: object) -> Devices | None:
    """Those that the caller names, those that hold the arrays, or none.

    Args:
        mesh: what the caller named, or None.
        arrays: of which the first that is spread by its leading axis is followed, then
            a mesh around the call (`jax.set_mesh`) that has the axis "pair".
    """
    if mesh is not None:
        if not isinstance(mesh, Mesh | AbstractMesh):
            raise TypeError(
                f"mesh: wanted a jax.sharding.Mesh, found {type(mesh).__name__}."
            )
        if PAIRS not in mesh.axis_names:
            raise ValueError(
                f"mesh: wanted one with an axis {PAIRS!r}, found axes "
                f"{mesh.axis_names}. Make it by jax.make_mesh(({mesh.size},), "
                f"({PAIRS!r},))."
            )
        return Devices(mesh, (PAIRS,))
    for x in arrays:
        if (found := _spread(x)) is not None:
            return found
    around = jax.sharding.get_abstract_mesh()
    if PAIRS in around.axis_names and PAIRS not in around.manual_axes:
        return Devices(around, (PAIRS,))
    return None


def map_rows(devices: Devices, function: Callable[[Tree], Out], rows: Tree) -> Out:
    """`function` of the rows that each device has, joined; traced.

    Args:
        devices: which.
        function: of a tree whose leaves have any number of rows, to one likewise.
        rows: arrays of one number of rows, None among them. They are filled up to a
            multiple of the parts, by copies of the last, which costs a collective.
    """
    num = len(jax.tree.leaves(rows)[0])
    spare = -num % devices.size
    spec = PartitionSpec(devices.axes)

    def placed(x: Array) -> Array:
        if spare:
            x = jnp.concatenate([x, jnp.repeat(x[-1:], spare, axis=0)])
        return _put(x, NamedSharding(devices.mesh, spec))

    # Nothing differs in type here: a check would turn branches into choices.
    apart = jax.shard_map(
        function, mesh=devices.mesh, in_specs=(spec,), out_specs=spec, check_vma=False
    )
    out = apart(jax.tree.map(placed, rows))
    if not spare:
        return out
    everywhere = NamedSharding(devices.mesh, PartitionSpec())
    return jax.tree.map(lambda x: _put(x, everywhere)[:num], out)


def spread_rows(devices: Devices | None, rows: Tree) -> Tree:
    """The same arrays, each row where it will be needed, without a program."""
    if devices is None:
        return rows
    num = len(jax.tree.leaves(rows)[0])
    if num % devices.size or isinstance(devices.mesh, AbstractMesh):
        return rows
    sharding = NamedSharding(devices.mesh, PartitionSpec(devices.axes))

    def put(x: Array) -> Array:
        if not is_concrete(x) or x.sharding == sharding or not x.is_fully_addressable:
            return x
        host = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, lambda at: host[at])

    return jax.tree.map(put, rows)


def _spread(x: object) -> Devices | None:
    """What the leading axis of an array is spread over, where its type or it tells."""
    if not isinstance(x, jax.Array):
        return None
    sharding = x.sharding if is_concrete(x) else jax.typeof(x).sharding
    if not isinstance(sharding, NamedSharding) or not sharding.spec:
        return None
    first = sharding.spec[0]
    axes = (first,) if isinstance(first, str) else first
    if not isinstance(axes, tuple) or sharding.mesh.size == 1 and is_concrete(x):
        return None
    return Devices(sharding.mesh, axes)


def _put(x: Array, sharding: NamedSharding) -> Array:
    explicit = any(kind == AxisType.Explicit for kind in sharding.mesh.axis_types)
    if explicit:
        return jax.sharding.reshard(x, sharding)
    return jax.lax.with_sharding_constraint(x, sharding)
