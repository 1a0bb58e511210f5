"""Rows of a batch over the devices of a mesh: JAX's own, each alone with its rows.

No device hears of another: there is no collective, but among those of a second axis
that share the particles of each row (`jaxreg._core.shares`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from jaxreg._core.checks import is_concrete
from jaxreg._core.shares import sharing


#: The axis of a mesh over which pairs, and graphs, are spread.
PAIRS = "pair"
#: That over which the particles of each pair are.
PARTICLES = "particle"

Tree = TypeVar("Tree")
Out = TypeVar("Out")


class Devices(NamedTuple):
    """Axes of a mesh, over which the leading axis of arrays is spread.

    Beside them that over which the particles of each row are, or None.
    """

    mesh: Mesh | AbstractMesh
    axes: tuple[str, ...]
    particles: str | None = None

    @property
    def size(self) -> int:
        """Parts that rows come in."""
        return math.prod(self.mesh.shape[axis] for axis in self.axes)

    @property
    def spec(self) -> PartitionSpec:
        """Of arrays by rows; of all arrays where no axis spreads rows."""
        return PartitionSpec(self.axes) if self.axes else PartitionSpec()


def chosen_devices(
    mesh: object, *arrays: object, particles: bool = False
) -> Devices | None:
    """Those that the caller names, those that hold the arrays, or none.

    Args:
        mesh: what the caller named, or None.
        arrays: of which the first that is spread by its leading axis is followed, then
            a mesh around the call (`jax.set_mesh`) that has an axis that is wanted.
        particles: whether there are any to spread: then the axis "particle" is wanted,
            too, not only "pair".
    """
    wanted: set[str] = {PAIRS, PARTICLES} if particles else {PAIRS}
    if mesh is not None:
        if not isinstance(mesh, Mesh | AbstractMesh):
            raise TypeError(
                f"mesh: wanted a jax.sharding.Mesh, found {type(mesh).__name__}."
            )
        found = _named(mesh, wanted & set(mesh.axis_names))
        if found is None:
            names, axes = " or ".join(map(repr, sorted(wanted))), mesh.axis_names
            why = "; only a search has particles" if PARTICLES in axes else ""
            raise ValueError(
                f"mesh: wanted one with an axis {names}, found axes {axes}{why}. Make "
                f"it by jax.make_mesh(({mesh.size},), ({PAIRS!r},))."
            )
        return found
    for x in arrays:
        if (found := _spread(x)) is not None:
            others = set(found.mesh.axis_names) - set(found.axes)
            shares = PARTICLES in wanted & others
            return found._replace(particles=PARTICLES if shares else None)
    around = jax.sharding.get_abstract_mesh()
    free = set(around.axis_names) - set(around.manual_axes)
    return _named(around, wanted & free)


def for_one(devices: Devices | None) -> Devices | None:
    """Those that share a problem that is no row of a batch, if any do."""
    if devices is None or devices.particles is None:
        return None
    return devices._replace(axes=())


def map_rows(devices: Devices, function: Callable[[Tree], Out], rows: Tree) -> Out:
    """`function` of the rows that each device has, joined; traced.

    Args:
        devices: which.
        function: of a tree whose leaves have any number of rows, to one likewise. It
            may share particles (`jaxreg._core.shares`).
        rows: arrays of one number of rows, None among them. They are filled up to a
            multiple of the parts, by copies of the last, which costs a collective.
            Without axes for rows they are any arrays, the same on all devices.
    """
    num = len(jax.tree.leaves(rows)[0])
    spare, spec = -num % devices.size, devices.spec

    def placed(x: Array) -> Array:
        if spare:
            x = jnp.concatenate([x, jnp.repeat(x[-1:], spare, axis=0)])
        return _put(x, NamedSharding(devices.mesh, spec))

    def of_device(rows: Tree) -> Out:
        with sharing(devices.particles):
            return function(rows)

    # Nothing differs in type here: a check would turn branches into choices.
    apart = jax.shard_map(
        of_device, mesh=devices.mesh, in_specs=(spec,), out_specs=spec, check_vma=False
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
    sharding = NamedSharding(devices.mesh, devices.spec)

    def put(x: Array) -> Array:
        if not is_concrete(x) or x.sharding == sharding or not x.is_fully_addressable:
            return x
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            data, impl = jax.random.key_data(x), jax.random.key_impl(x)
            return jax.random.wrap_key_data(put(data), impl=impl)
        host = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, lambda at: host[at])

    return jax.tree.map(put, rows)


def _named(mesh: Mesh | AbstractMesh, names: set[str]) -> Devices | None:
    """Those of the axes by name, if there are any."""
    pairs = (PAIRS,) if PAIRS in names else ()
    particles = PARTICLES if PARTICLES in names else None
    return Devices(mesh, pairs, particles) if names else None


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
