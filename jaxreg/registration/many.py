"""Many pairs: in groups of one size, in chunks over the cores of a CPU."""

import math
from collections.abc import Callable, Hashable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxreg._core.checks import is_concrete
from jaxreg._core.cores import num_cores
from jaxreg._core.platforms import platform_of
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Progress
from jaxreg.batching.devices import Devices, map_rows, spread_rows
from jaxreg.batching.padding import (
    rounded_up,
    stacked,
    unstacked,
)
from jaxreg.batching.progress import tell
from jaxreg.batching.side_by_side import side_by_side
from jaxreg.batching.threads import map_in_threads
from jaxreg.registrar import AbstractRegistrar, GivenPair, RegistrationSolution
from jaxreg.registration.pair import register_pair


_STAGE = "registering pairs"
# Pairs in one call of a compiled program: less than a few are slowed by calling it.
_CHUNK = 8
# Rows of padding that cost as much time as compiling another program, some seconds.
_MOST_PADDING = 1 << 24

# Pairs, initial poses, and the data of keys; all with a leading axis.
_Pairs = tuple[GivenPair, Array | None, Array | None]
_Tree = TypeVar("_Tree")
# Pairs of one size: their numbers, and some of them as arrays with a leading axis.
_Group = tuple[np.ndarray, Callable[[np.ndarray], _Pairs]]


def register_batch(
    method: AbstractRegistrar,
    batch: tuple[int, ...],
    pair: GivenPair,
    init: Array | None,
    key: Array | None,
    batch_size: int | None,
    progress: Progress | None,
    devices: Devices | None,
) -> RegistrationSolution:
    """Of pairs of one size."""
    num = math.prod(batch)
    data, impl = _split(key, num)

    def flat(x: Array) -> Array:
        return x.reshape(num, *x.shape[len(batch) :])

    every = (*jax.tree.map(flat, (pair, init)), data)
    tell(progress, _STAGE, 0, num, every)
    threads = devices is None and num > 0 and _in_threads(method, every)
    every = _on_host(every) if threads else every

    def of_rows(rows: np.ndarray) -> _Pairs:
        if len(rows) == num:
            return jax.tree.map(_on_device, every)
        return jax.tree.map(lambda x: _on_device(x[rows]), every)

    group = np.arange(num), of_rows
    how = impl, threads, batch_size, progress, devices
    solution = _register_groups(method, [group], *how)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), solution)


def register_lists(
    method: AbstractRegistrar,
    lists: tuple[list[Array], ...],
    viewpoints: Array | None,
    init: Array | None,
    key: Array | None,
    batch_size: int | None,
    progress: Progress | None,
    devices: Devices | None,
) -> list[RegistrationSolution]:
    """Of each pair of two lists; they are padded to few sizes."""
    sources, targets, source_masks, target_masks = lists
    data, impl = _split(key, len(sources))
    each = viewpoints, init, data
    tell(progress, _STAGE, 0, len(sources), lists, each)
    threads = devices is None and _in_threads(method, (lists, each))
    each = _on_host(each) if threads else each

    def group(sizes: np.ndarray, members: np.ndarray) -> _Group:
        n, m = sizes.tolist()

        def of_rows(rows: np.ndarray) -> _Pairs:
            rows = members[rows]
            seen, init, data = jax.tree.map(lambda x: _on_device(x[rows]), each)
            pairs = GivenPair(
                stacked([sources[i] for i in rows], n),
                stacked([targets[i] for i in rows], m),
                stacked([source_masks[i] for i in rows], n),
                stacked([target_masks[i] for i in rows], m),
                seen,
            )
            return pairs, init, data

        return members, of_rows

    sizes = np.array([[rounded_up(len(x)) for x in xs] for xs in (sources, targets)])
    groups = [group(*same) for same in _of_similar_size(sizes.T)]
    how = impl, threads, batch_size, progress, devices
    found = _register_groups(method, groups, *how)
    return unstacked(found, len(sources))


def _of_similar_size(sizes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sizes to pad pairs to, given `(num, 2)`, and the rows of those pairs."""
    largest = sizes.max(axis=0)
    if np.sum(largest - sizes) <= _MOST_PADDING:
        return [(largest, np.arange(len(sizes)))]
    kinds, kind = np.unique(sizes, axis=0, return_inverse=True)
    return [(size, np.flatnonzero(kind == k)) for k, size in enumerate(kinds)]


def _split(key: Array | None, num: int) -> tuple[Array | None, Hashable]:
    """Data of a key for each pair, and what kind of key it is of."""
    if key is None:
        return None, None
    return jax.random.key_data(jax.random.split(key, num)), jax.random.key_impl(key)


def _in_threads(*inputs: object) -> bool:
    """Whether to use the cores of a CPU, on which XLA runs a loop on one."""
    arrays = jax.tree.leaves(inputs)
    return platform_of(arrays) == "cpu" and all(map(is_concrete, arrays))


def _on_host(arrays: _Tree) -> _Tree:
    """The same memory: to take rows of it compiles nothing."""
    return jax.tree.map(np.asarray, arrays)


def _register_groups(
    method: AbstractRegistrar,
    groups: list[_Group],
    impl: Hashable,
    threads: bool,
    batch_size: int | None,
    progress: Progress | None,
    devices: Devices | None,
) -> RegistrationSolution:
    """Group after group, the solutions in the order of the pairs' numbers."""
    parts, done, total = [], 0, sum(len(members) for members, _ in groups)
    for members, of_rows in groups:

        def some(rows: np.ndarray, of_rows: Callable = of_rows) -> RegistrationSolution:
            pairs = spread_rows(devices, of_rows(rows))
            num_points = pairs[0].source.shape[1] + pairs[0].target.shape[1]
            lanes = side_by_side(batch_size, num_points, pairs)
            return _register_rows(method, pairs, impl, lanes, devices)

        rows = np.arange(len(members))
        for part in (
            _over_cores(some, rows, batch_size or 1) if threads else [some(rows)]
        ):
            parts.append(part)
            done += len(part.status)
            tell(progress, _STAGE, done, total, part)
    if len(parts) == 1:
        return jax.tree.map(_on_device, parts[0])
    order = np.argsort(np.concatenate([members for members, _ in groups]))
    xp = np if threads else jnp
    return jax.tree.map(lambda *x: _on_device(xp.concatenate(x)[order]), *parts)


def _on_device(x: Array | np.ndarray) -> Array:
    """Where it is, of several hosts, too; or moved there in so many words."""
    return x if isinstance(x, jax.Array) else jax.device_put(x)


def _over_cores(
    register_rows: Callable[[np.ndarray], RegistrationSolution],
    rows: np.ndarray,
    batch_size: int,
) -> Iterator[RegistrationSolution]:
    """In chunks of one size, as many at a time as there are cores; NumPy arrays."""
    num, cores = len(rows), num_cores()
    chunk = max(min(num // (4 * cores), _CHUNK), 1)
    chunk = 1 << (chunk.bit_length() - 1)  # another number of pairs compiles nothing
    chunk = min(max(chunk, batch_size), num)

    def run(start: int) -> RegistrationSolution:
        first = min(start, num - chunk)
        found = register_rows(rows[first : first + chunk])
        return jax.tree.map(lambda x: np.asarray(x)[start - first :], found)

    return map_in_threads(run, range(0, num, chunk), cores)


@kept_program
def _register_rows(
    method: AbstractRegistrar,
    pairs: _Pairs,
    impl: Hashable,
    batch_size: int,
    devices: Devices | None,
) -> RegistrationSolution:
    """One group after another: memory stays bounded."""

    def one(given: _Pairs) -> RegistrationSolution:
        pair, init, data = given
        key = None if data is None else jax.random.wrap_key_data(data, impl=impl)
        return register_pair(method, pair, init, key)

    # Groups of one would be vectorised over an axis of one: conditions become selects.
    num = len(pairs[0].source)
    size = min(batch_size, num) if batch_size > 1 else None

    def some(pairs: _Pairs) -> RegistrationSolution:
        return lax.map(one, pairs, batch_size=size)

    return some(pairs) if devices is None else map_rows(devices, some, pairs)
