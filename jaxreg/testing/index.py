"""The promises of an index of closest points."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.neighbours import AbstractIndex, Neighbours
from jaxreg.testing.promises import promise, promise_dtypes, promise_equal


_M, _N = 300, 200
_UNIT = 1024.0

Build = Callable[..., AbstractIndex]
#: What is found, and the reach, of targets, a mask, queries and a radius.
Find = Callable[..., tuple[Neighbours, jax.Array]]


def check_index(build: Build, *, recall: float = 1.0, k: int = 1) -> None:
    """Searches 300 random points, in float32 and float64, and compares all pairs.

    Promised are: within its `reach` at least the share `recall` of the answers are as
    near as the nearest; distances are those to the points found, which are valid;
    masked targets and those that are not finite are never found; a query that is not
    finite is flagged alone, and all are where no target is valid; a radius flags what
    is farther; how many queries `num` asks for changes none of them; the same answer
    compiled and side by side with others; gradients of squared distances by queries and
    targets; with k > 1 that so many are found, distinct and in order.

    Args:
        build: as `AbstractIndex.build`, such as `BruteForce.build` or a `partial` of
            it, of `(m, d)` points and a mask.
        recall: in [0, 1]; one for an exact index.
        k: how many it can find.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    find, name = _finder(build), _name(build)
    for d in (2, 3):
        for dtype in (np.float32, np.float64):
            with jax.enable_x64(dtype is np.float64):
                of = f"{name} in {d}D, {np.dtype(dtype).name}"
                _promise_search(of, find, _clouds(d, dtype), recall)
    clouds = _clouds(3, np.float32)
    _promise_transformations(name, build, find, clouds)
    _promise_flags(name, find, clouds)
    if k > 1:
        _promise_several(name, build, clouds, k)


def _name(build: Build) -> str:
    built = build(jnp.zeros((1, 3), jnp.float32), jnp.ones(1, bool))
    promise(
        isinstance(built, AbstractIndex),
        f"build: wanted an AbstractIndex, found {type(built).__name__}.",
    )
    return type(built).__name__


def _clouds(d: int, dtype: type, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Targets, a mask, and queries around them."""
    rng = np.random.default_rng(seed)
    target = rng.random((_M, d))
    queries = target[rng.permutation(_M)[:_N]] + 0.1 * rng.standard_normal((_N, d))
    return target.astype(dtype), rng.random(_M) < 0.7, queries.astype(dtype)


def _distances(target: np.ndarray, mask: np.ndarray, queries: np.ndarray):
    """`(n, m)` in float64, inf to masked targets."""
    delta = queries[:, None].astype(float) - target[None].astype(float)
    return np.where(mask, np.linalg.norm(delta, axis=-1), np.inf)


def _finder(build: Build, k: int = 1) -> Find:
    """Compiled."""

    def find(target, mask, queries, radius=jnp.inf):
        index = build(target, mask)
        return index.query(queries, k, jnp.asarray(radius, target.dtype)), index.reach

    return jax.jit(find)


def _promise_search(name: str, find: Find, clouds: tuple, recall: float) -> None:
    target, mask, queries = clouds
    found, reach = find(target, mask, queries)
    row, valid = np.asarray(found.index), np.asarray(found.valid)
    promise_dtypes((found, reach), target.dtype, name)
    promise(row.shape == (_N,), f"{name}: {_N} queries have {row.shape} answers.")
    promise((row >= 0) & (row < _M), f"{name}: a row is beyond the targets.")
    promise(mask[row], f"{name}: a masked target is found.")
    true = _distances(target, mask, queries)
    mine, least = true[np.arange(_N), row], true.min(1)
    promise_equal(
        np.sqrt(found.sq_distance).astype(float),
        mine,
        f"{name}: sq_distance is not the squared distance to the point found",
        rtol=1e-5,
        atol=1e-6,
    )
    near = least <= float(reach) * (1 - 1e-5)
    promise(valid[near & (mine <= least)], f"{name}: a target in reach is invalid.")
    share = float(np.mean(mine[near] <= least[near] * (1 + 1e-6) + 1e-7))
    promise(
        share >= recall,
        f"{name}: {share:.3f} of the answers are the nearest; wanted {recall:.3f}.",
    )
    units = find(_UNIT * target, mask, _UNIT * queries)[0]
    if recall == 1 and np.isinf(reach):
        promise(units.index == row, f"{name}: another unit changes what is found.")


def _promise_transformations(
    name: str, build: Build, find: Find, clouds: tuple
) -> None:
    sets = [clouds, _clouds(3, np.float32, 1)]
    batched, _ = jax.jit(jax.vmap(find))(*map(np.stack, zip(*sets, strict=True)))
    for lane, one in enumerate(sets):
        same = np.array_equal(batched.index[lane], find(*one)[0].index)
        promise(same, f"{name}: alone and side by side do not find the same.")
    target, mask, queries = map(jnp.asarray, clouds)
    built = build(target, mask)
    eager = built.query(queries)
    promise(
        np.array_equal(eager.index, find(*clouds)[0].index),
        f"{name}: compiled and not do not find the same.",
    )
    columns = jnp.tile(queries, (40, 1)).T

    def in_three_ways(num: jax.Array, coarse: jax.Array) -> tuple[jax.Array, ...]:
        all_, some = built.lookup(columns), built.lookup(columns, num)
        return all_, some, built.lookup(columns, coarse=coarse)

    ways = jax.jit(in_three_ways)(jnp.asarray(300), jnp.asarray(True))
    every, some, near = map(np.asarray, ways)
    promise(
        np.array_equal(some[:300], every[:300]),
        f"{name}: how many are answered changes the first.",
    )
    promise(mask[near], f"{name}: a coarse answer is a masked target.")

    def total(target: jax.Array, queries: jax.Array) -> jax.Array:
        return jnp.sum(build(target, mask).query(queries).sq_distance)

    by_target, by_query = jax.jit(jax.grad(total, (0, 1)))(target, queries)
    delta = 2 * (queries - target[eager.index])
    wanted = jnp.zeros_like(target).at[eager.index].add(-delta)
    what = f"{name}: gradients of squared distances are not those of the points found"
    promise_equal((by_target, by_query), (wanted, delta), what, rtol=1e-4, atol=1e-5)


def _promise_flags(name: str, find: Find, clouds: tuple) -> None:
    target, mask, queries = clouds
    expected = find(*clouds)[0]
    nothing = find(target, np.zeros_like(mask), queries)[0]
    promise(~nothing.valid, f"{name}: something is found where no target is valid.")
    promise(np.isinf(nothing.sq_distance), f"{name}: at a distance that is not inf.")
    broken = queries.copy()
    broken[3], broken[5, 0], broken[7, 2] = np.nan, np.inf, -np.inf
    found = find(target, mask, broken)[0]
    others = ~np.isin(np.arange(_N), [3, 5, 7])
    promise(~found.valid[~others], f"{name}: a query that is not finite is valid.")
    promise(
        np.array_equal(found.index[others], expected.index[others]),
        f"{name}: a query that is not finite changes the answers of others.",
    )
    rows = np.asarray(found.index)
    promise((rows >= 0) & (rows < _M), f"{name}: a row is beyond the targets.")
    broken, sound = target.copy(), np.arange(_M) % 2 == 1
    broken[::2] = np.nan
    broken[4, 1:], broken[6] = 0, np.inf
    promise(
        np.array_equal(
            find(broken, np.ones_like(mask), queries)[0].index,
            find(target, sound, queries)[0].index,
        ),
        f"{name}: targets that are not finite are not as masked ones.",
    )
    for radius in (0.05, 0.1):
        found, reach = find(*clouds, radius)
        mine = np.sqrt(np.asarray(found.sq_distance))
        near = mine <= min(radius, float(reach))
        promise(
            np.array_equal(found.valid, near),
            f"{name}: a radius of {radius} flags other answers than those beyond it.",
        )


def _promise_several(name: str, build: Build, clouds: tuple, k: int) -> None:
    find, (target, mask, queries) = _finder(build, k), clouds
    found = find(*clouds)[0]
    row = np.asarray(found.index)
    promise(row.shape == (_N, k), f"{name}: k={k} gives the shape {row.shape}.")
    promise(mask[row], f"{name}: a masked target is found.")
    ordered = np.sort(row, axis=1)
    promise(np.diff(ordered, axis=1) > 0, f"{name}: a target is found twice.")
    true = np.sort(_distances(target, mask, queries), axis=1)[:, :k]
    promise_equal(
        np.linalg.norm(queries[:, None].astype(float) - target[row], axis=2),
        true,
        f"{name}: the {k} nearest are others, or in another order",
        rtol=1e-4,
        atol=1e-6,
    )
    few = find(target, np.arange(_M) < k - 1, queries)[0]
    promise(
        np.asarray(few.valid).sum(1) == k - 1,
        f"{name}: of {k - 1} targets not as many are valid.",
    )
